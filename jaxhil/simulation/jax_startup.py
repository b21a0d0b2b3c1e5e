"""Checks that JAX can start in this process, so that a failure results in a one-line error message.

Without these checks there would be three kinds of failure. XLA ends the process if XLA_FLAGS contains an
unknown flag. JAX raises a long exception if a platform in JAX_PLATFORMS has no device. A process hangs if it
was forked from a process that runs JAX.
"""

import os
import re
import subprocess
import sys
from functools import cache
from importlib.metadata import version

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import open_input

MAX_REASON_LENGTH = 300  # longest quotation of XLA and JAX in our messages [characters]

_FLAG_TEST_CODE = "import jax; jax.jit(lambda: 0)()"
# Format of the message that XLA writes before it ends the process.
_LOG_LINE = re.compile(r"[EF]\d{4} .*?\] (.*)|(xla: .*)")
# Ids of processes that have started JAX: this process, and the process from which this process was forked.
_processes: set[int] = set()


@cache
def check_xla_flags(flags: str) -> None:
    """Raise `InputError` if XLA rejects these flags.

    The flags are tested in a child process, because XLA ends a process with an invalid flag.
    """
    variables = {
        name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "TF_CPP_"))
    }
    result = subprocess.run(
        [sys.executable, "-P", "-c", _FLAG_TEST_CODE],
        env={**variables, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "JAX_TRACEBACK_FILTERING": "off"},
        capture_output=True,
        encoding="utf-8",
        errors="backslashreplace",
        check=False,
    )
    if result.returncode:
        lines = result.stderr.splitlines() or [f"exit code {result.returncode}"]
        [reason] = [match[1] or match[2] for match in map(_LOG_LINE.match, lines) if match][:1] or lines[-1:]
        allowed = f"flags of jaxlib {version('jaxlib')}, or none"
        message = to_one_line(reason, MAX_REASON_LENGTH)
        raise InputError(
            f"XLA_FLAGS: found {format_value(flags, MAX_REASON_LENGTH)}, expected {allowed} (XLA: {message})"
        )


def read_xla_flags(name: str) -> str:
    """Return the XLA flags in the file `name`; raise `InputError` if the file cannot be read."""
    try:
        with open_input(name) as file:
            return " ".join(file.read().decode().split())
    except (OSError, ValueError):
        allowed = "flags that begin with --, or a file of flags"
        raise InputError(f"XLA_FLAGS: found {format_value(name)}, expected {allowed}") from None


def find_startup_error() -> InputError | None:
    """Return the error that JAX raises at its start; None if JAX starts or has not been imported."""
    try:
        if "jax" in sys.modules:
            import jax

            jax.numpy.zeros(()).block_until_ready()
    except (AssertionError, AttributeError, RuntimeError, ValueError) as error:
        return convert_jax_error(error)
    return None


def convert_jax_error(error: Exception) -> InputError:
    """Convert an exception from the start of JAX to an `InputError` with a one-line message."""
    variables = {name: value for name, value in sorted(os.environ.items()) if name.startswith("JAX_")}
    found = ", ".join(f"{name}={value}" for name, value in variables.items()) or "no variable JAX_... set"
    reason = str(error) or "there is no such device"
    allowed = "values with which jax starts"
    return InputError(
        f"environment: found {to_one_line(found, MAX_REASON_LENGTH)}, expected {allowed} "
        f"({to_one_line(reason, MAX_REASON_LENGTH)})"
    )


def check_not_forked() -> None:
    """Raise `InputError` if this process was forked from one that runs JAX, because JAX would hang here."""
    _processes.add(os.getpid())
    if len(_processes) > 1:
        allowed = 'a spawned one: use multiprocessing.get_context("spawn")'
        raise InputError(f"process: found a process forked after the start of JAX, expected {allowed}")
