"""The command `jaxhil`, also `python -m tuning`: from arguments to an exit code, without a traceback.

0 done and good; 1 done, and the verdict is bad; 2 unusable input or an impossible write, reported in one
line; 130 interrupted.
"""

import gc
import io
import os
import sys
from collections.abc import Sequence

from jaxhil.errors import InputError, one_line

GOOD, BAD, UNUSABLE, INTERRUPTED = 0, 1, 2, 130
TRACEBACK = "JAXHIL_TRACEBACK"  # set: what goes wrong inside is shown in full


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code. `--help` and wrong arguments end in `SystemExit`.

    Raises what goes wrong inside when the environment asks for tracebacks.
    """
    for stream in (sys.stdout, sys.stderr):
        # A name that the terminal's encoding lacks is no reason to fail.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        if sys.stdout is None:
            # The next file that is opened would take its place, and what is printed would go into that.
            raise InputError("standard output: found it closed, expected it open, or sent to /dev/null")
        from tuning.cli.parser import parse

        code = parse(arguments)()
        sys.stdout.flush()
        return code
    except InputError as error:
        # What is wrong with an argument of a function is wrong with the option of that name.
        return _complain(getattr(error, "option", str(error)), UNUSABLE)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # Of a text without a verdict, such as a list or the help.
        _silence()
        return GOOD
    except OSError as error:
        where = f"{one_line(os.fspath(error.filename))}: " if isinstance(error.filename, str) else ""
        return _complain(f"{where}{one_line(error.strerror or str(error), 200)}", UNUSABLE)
    except Exception as error:
        if os.environ.get(TRACEBACK):
            raise
        from jaxhil.simulation import startup

        if (problem := startup.problem()) is not None:
            return _complain(str(problem), UNUSABLE)
        reason = one_line(f"{type(error).__name__}: {error}", 200)
        return _complain(f"internal error: {reason} (set {TRACEBACK}=1 to see where)", UNUSABLE)


def command() -> None:
    """`main` as a process of its own, which ends with its exit code."""
    _open_streams()
    os.environ["MPLBACKEND"] = "agg"  # pictures are files: whatever windows the user has for others
    code = main()
    # The last collection would look at all that jax made: a fifth of a short command's time.
    gc.freeze()
    sys.exit(code)


def _open_streams() -> None:
    """Let the null device stand for a closed standard input or error, in whose place a file would come."""
    for number, name, mode in ((0, "stdin", "r"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, open(number, mode, encoding="utf-8"))


def _complain(text: str, code: int) -> int:
    try:
        print(f"jaxhil: {text}", file=sys.stderr, flush=True)
    except OSError:
        _silence()
    return code


def _silence() -> None:
    """Nobody listens any more: keep the interpreter's own flush at exit from complaining about it."""
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
    except (OSError, ValueError):
        pass


if __name__ == "__main__":
    command()
