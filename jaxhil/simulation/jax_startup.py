"""Checks that JAX can start in this process, so that a failure gives one line and not a crash.

XLA ends the process for an unknown flag in XLA_FLAGS. JAX raises an exception if there is no device of the
kind in JAX_PLATFORMS. A process forked from one that runs JAX hangs.
"""

import os
import re
import subprocess
import sys
from functools import cache
from importlib.metadata import version

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import open_input

MAX_REASON_LENGTH = 300  # characters; greatest length of a reason in a message

_FLAG_TEST_CODE = "import jax; jax.jit(lambda: 0)()"
_LOG_LINE = re.compile(r"[EF]\d{4} .*?\] (.*)|(xla: .*)")  # last message of XLA before it ends the process
_processes: set[int] = set()  # ids of processes that started JAX: this one, or one from which it was forked


@cache
def check_xla_flags(flags: str) -> None:
    """Raise `InputError` if XLA rejects the flags; a separate process tests them, since XLA would end it."""
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
    """Return the flags in a file, which XLA accepts too; raise `InputError` if it cannot be read."""
    try:
        with open_input(name) as file:
            return " ".join(file.read().decode().split())
    except (OSError, ValueError):
        allowed = "flags that begin with --, or a file of flags"
        raise InputError(f"XLA_FLAGS: found {format_value(name)}, expected {allowed}") from None


def find_startup_error() -> InputError | None:
    """Return the error with which JAX does not start; None if it starts or was not asked to."""
    try:
        if "jax" in sys.modules:
            import jax

            jax.numpy.zeros(()).block_until_ready()
    except (AssertionError, AttributeError, RuntimeError, ValueError) as error:
        return convert_jax_error(error)
    return None


def convert_jax_error(error: Exception) -> InputError:
    """Return JAX's exception, raised during import or access to its devices, as a one-line error."""
    variables = {name: value for name, value in sorted(os.environ.items()) if name.startswith("JAX_")}
    found = ", ".join(f"{name}={value}" for name, value in variables.items()) or "no variable JAX_... set"
    reason = str(error) or "there is no such device"
    allowed = "values with which jax starts"
    return InputError(
        f"environment: found {to_one_line(found, MAX_REASON_LENGTH)}, expected {allowed} "
        f"({to_one_line(reason, MAX_REASON_LENGTH)})"
    )


def check_not_forked() -> None:
    """Raise `InputError` in a process forked after JAX had been started, since it would hang."""
    _processes.add(os.getpid())
    if len(_processes) > 1:
        allowed = 'one begun by spawn: multiprocessing.get_context("spawn")'
        raise InputError(f"process: found one forked after jax had started, expected {allowed}")
