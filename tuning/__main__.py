"""Entry point of the command `jaxhil` and of `python -m tuning`.

The exit code is 0 if the command succeeds and its verdict, if any, is good; 1 if the verdict is bad; 2 if the
input is unusable or the output cannot be written; 130 if the command is interrupted. Errors are reported in
one line, without a traceback.
"""

import contextlib
import gc
import io
import os
import sys
from collections.abc import Sequence

from jaxhil.errors import InputError, to_one_line

EXIT_GOOD, EXIT_BAD, EXIT_UNUSABLE_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130
# Environment variable; if it is set, internal errors are shown with a traceback.
TRACEBACK_VARIABLE = "JAXHIL_TRACEBACK"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    `--help` and wrong arguments raise `SystemExit`. An internal error is reported in one line; if the
    environment variable `JAXHIL_TRACEBACK` is set, the error is raised instead.
    """
    for stream in (sys.stdout, sys.stderr):
        # The command must not fail because the terminal's encoding lacks a character.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    words = sys.argv[1:] if arguments is None else arguments
    try:
        if sys.stdout is None:
            # The next opened file would get the descriptor of standard output, and the printed text with it.
            raise InputError(
                "standard output: found a closed stream, expected an open one: to discard the output, "
                "redirect it to /dev/null"
            )
        from tuning.cli.parser import parse

        code = parse(words)()
        sys.stdout.flush()
        return code
    except SystemExit as stop:
        # The parser has printed its message for wrong arguments on standard error.
        if stop.code == EXIT_UNUSABLE_INPUT:
            _print_error_document(words, "wrong arguments: see standard error", EXIT_UNUSABLE_INPUT)
        raise
    except InputError as error:
        # If the error has a text that names the command's option, that text is printed.
        return _report_error(words, getattr(error, "option", str(error)), EXIT_UNUSABLE_INPUT)
    except KeyboardInterrupt:
        return _report_error(words, "interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # Only commands without a verdict get here, for example a list or the help.
        _discard_output()
        return EXIT_GOOD
    except OSError as error:
        where = f"{to_one_line(os.fspath(error.filename))}: " if isinstance(error.filename, str) else ""
        reason = to_one_line(error.strerror or str(error), 200)
        return _report_error(words, f"{where}{reason}", EXIT_UNUSABLE_INPUT)
    except Exception as error:
        if os.environ.get(TRACEBACK_VARIABLE):
            raise
        from jaxhil.simulation import jax_startup

        if (problem := jax_startup.find_startup_error()) is not None:
            return _report_error(words, str(problem), EXIT_UNUSABLE_INPUT)
        reason = to_one_line(f"{type(error).__name__}: {error}", 200)
        problem = f"internal error: {reason} (set {TRACEBACK_VARIABLE}=1 for a traceback)"
        return _report_error(words, problem, EXIT_UNUSABLE_INPUT)


def command() -> None:
    """Run `main`, and end the process with the exit code that `main` returns."""
    _open_closed_streams()
    os.environ["MPLBACKEND"] = "agg"  # plots are files, so a window system must not be used
    code = main()
    # Frozen objects are not collected at exit; collecting them would take a fifth of a short command's time.
    gc.freeze()
    sys.exit(code)


def _open_closed_streams() -> None:
    """Replace a closed standard input or standard error by the null device.

    Otherwise the next opened file would get the descriptor of the closed stream.
    """
    for number, name, mode in ((0, "stdin", "r"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, open(number, mode, encoding="utf-8"))


def _report_error(words: Sequence[str], text: str, code: int) -> int:
    """Print an error on standard error and, with `--json`, as JSON on standard output; return `code`."""
    try:
        print(f"jaxhil: {text}", file=sys.stderr, flush=True)
    except OSError:
        _discard_output()
    _print_error_document(words, text, code)
    return code


def _print_error_document(words: Sequence[str], text: str, code: int) -> None:
    """Print an error as a JSON document on standard output if the arguments contain `--json`."""
    if "--json" not in words or sys.stdout is None:
        return
    from tuning import terminal

    verdict = terminal.INTERRUPTED if code == EXIT_INTERRUPTED else terminal.UNUSABLE_INPUT
    with contextlib.suppress(InputError):  # standard output cannot be written
        command = next((word for word in words if not word.startswith("-")), "")
        terminal.emit_json_error(command, verdict, [text])


def _discard_output() -> None:
    """Redirect standard output and standard error to the null device.

    At exit, the interpreter flushes both streams, which would fail for a broken pipe.
    """
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(null, stream.fileno())
    except (OSError, ValueError):
        pass


if __name__ == "__main__":
    command()
