"""Checks that jax can start in this process, so that a failure is one line and not the end of the process.

XLA ends the process where it does not know one of XLA_FLAGS; jax raises where it has no device of the kind in
JAX_PLATFORMS; and a process that was forked from one in which jax runs hangs.
"""

import os
import re
import subprocess
import sys
from functools import cache
from importlib.metadata import version

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import open_input

LONGEST = 300  # characters of a reason

_PROBE = "import jax; jax.jit(lambda: 0)()"
_LOG_LINE = re.compile(r"[EF]\d{4} .*?\] (.*)|(xla: .*)")  # what XLA writes where it ends
_processes: set[int] = set()  # in which a caller's jax was started: this one, or one that it was forked from


@cache
def check_flags(flags: str) -> None:
    """Raise `InputError` if XLA refuses the flags; another process, which it ends, tries them."""
    given = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "TF_CPP_"))}
    tried = subprocess.run(
        [sys.executable, "-P", "-c", _PROBE],
        env={**given, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "JAX_TRACEBACK_FILTERING": "off"},
        capture_output=True,
        encoding="utf-8",
        errors="backslashreplace",
        check=False,
    )
    if tried.returncode:
        lines = tried.stderr.splitlines() or [f"exit code {tried.returncode}"]
        [reason] = [match[1] or match[2] for match in map(_LOG_LINE.match, lines) if match][:1] or lines[-1:]
        allowed = f"flags of jaxlib {version('jaxlib')}, or none"
        said = one_line(reason, LONGEST)
        raise InputError(f"XLA_FLAGS: found {shown(flags, LONGEST)}, expected {allowed} (XLA: {said})")


def flags_of_file(name: str) -> str:
    """Return the flags in a file, which XLA takes too. Raise `InputError` if it cannot be read."""
    try:
        with open_input(name) as file:
            return " ".join(file.read().decode().split())
    except (OSError, ValueError):
        allowed = "flags that begin with --, or a file of flags"
        raise InputError(f"XLA_FLAGS: found {shown(name)}, expected {allowed}") from None


def problem() -> InputError | None:
    """Return why jax does not start; None if it does, or if nothing has asked it to."""
    try:
        if "jax" in sys.modules:
            import jax

            jax.numpy.zeros(()).block_until_ready()
    except (AssertionError, AttributeError, RuntimeError, ValueError) as error:
        return as_input_error(error)
    return None


def as_input_error(error: Exception) -> InputError:
    """Return an error that jax raised when it was imported, or asked for its devices, as one line."""
    given = {name: value for name, value in sorted(os.environ.items()) if name.startswith("JAX_")}
    found = ", ".join(f"{name}={value}" for name, value in given.items()) or "no variable JAX_... set"
    reason = str(error) or "there is no such device"
    allowed = "values with which jax starts"
    return InputError(
        f"environment: found {one_line(found, LONGEST)}, expected {allowed} ({one_line(reason, LONGEST)})"
    )


def check_process() -> None:
    """Raise `InputError` in a process forked after jax had been started: it would hang."""
    _processes.add(os.getpid())
    if len(_processes) > 1:
        allowed = 'one begun by spawn: multiprocessing.get_context("spawn")'
        raise InputError(f"process: found one forked after jax had started, expected {allowed}")
