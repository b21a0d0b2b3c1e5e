"""Command `jaxhil`, also `python -m tuning`: converts arguments to an exit code, without a traceback.

Exit codes: 0 for success with a good verdict, 1 for success with a bad verdict, 2 for unusable input or
output that cannot be written (reported in one line), and 130 for an interrupted command.
"""

import gc
import io
import os
import sys
from collections.abc import Sequence

from jaxhil.errors import InputError, to_one_line

EXIT_GOOD, EXIT_BAD, EXIT_UNUSABLE_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
TRACEBACK_VARIABLE = (
    "JAXHIL_TRACEBACK"  # environment variable; if it is set, internal errors are shown with a traceback
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    `--help` and wrong arguments raise `SystemExit`. An internal error is raised if the environment variable
    `JAXHIL_TRACEBACK` is set, and reported in one line otherwise.
    """
    for stream in (sys.stdout, sys.stderr):
        # A character that the terminal's encoding lacks must not make the command fail.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        if sys.stdout is None:
            # The next opened file would get the descriptor of standard output, and the prints.
            raise InputError("standard output: found it closed, expected it open, or sent to /dev/null")
        from tuning.cli.parser import parse

        code = parse(arguments)()
        sys.stdout.flush()
        return code
    except InputError as error:
        # An error in an argument of a function is reported as an error in the option of that name.
        return _print_error(getattr(error, "option", str(error)), EXIT_UNUSABLE_INPUT)
    except KeyboardInterrupt:
        return _print_error("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # Only output without a verdict, such as a list or the help, ends here.
        _discard_output()
        return EXIT_GOOD
    except OSError as error:
        where = f"{to_one_line(os.fspath(error.filename))}: " if isinstance(error.filename, str) else ""
        return _print_error(f"{where}{to_one_line(error.strerror or str(error), 200)}", EXIT_UNUSABLE_INPUT)
    except Exception as error:
        if os.environ.get(TRACEBACK_VARIABLE):
            raise
        from jaxhil.simulation import jax_startup

        if (problem := jax_startup.find_startup_error()) is not None:
            return _print_error(str(problem), EXIT_UNUSABLE_INPUT)
        reason = to_one_line(f"{type(error).__name__}: {error}", 200)
        return _print_error(
            f"internal error: {reason} (set {TRACEBACK_VARIABLE}=1 to see where)", EXIT_UNUSABLE_INPUT
        )


def command() -> None:
    """Run `main` as a process of its own, which ends with its exit code."""
    _open_closed_streams()
    os.environ["MPLBACKEND"] = "agg"  # plots are files, so a window system must not be used
    code = main()
    # Without freezing, the last garbage collection takes a fifth of a short command's time.
    gc.freeze()
    sys.exit(code)


def _open_closed_streams() -> None:
    """Open the null device for a closed standard input or error, so that no file gets its descriptor."""
    for number, name, mode in ((0, "stdin", "r"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, open(number, mode, encoding="utf-8"))


def _print_error(text: str, code: int) -> int:
    """Print a message on standard error, if it is open, and return the exit code."""
    try:
        print(f"jaxhil: {text}", file=sys.stderr, flush=True)
    except OSError:
        _discard_output()
    return code


def _discard_output() -> None:
    """Redirect the output streams to the null device, so that the interpreter's last flush does not fail."""
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(null, stream.fileno())
    except (OSError, ValueError):
        pass


if __name__ == "__main__":
    command()
