"""Code that runs on the workers of a dask.distributed cluster.

A worker imports this module with its first work unit. It then sets the same flags of JAX as a command does,
before it imports JAX. If other code on the worker imports JAX earlier, start the worker with
`PRELOAD_COMMAND`, so that dask loads this module first.
"""

import pickle
import threading
from typing import Any, NamedTuple

from jaxhil.errors import InputError
from jaxhil.simulation.jax_environment import active_xla_flags, prepare_jax, rounding_flags
from jaxhil.simulation.source_fingerprint import dependency_versions, sources_sha256

PRELOAD_COMMAND = "dask worker ADDRESS --preload tuning.caches.worker"

# A worker can have several threads, but only one compiled program may run at a time.
_run_lock = threading.Lock()


class ProcessSetting(NamedTuple):
    """Properties of a process that affect the last bits of a result."""

    sources_sha256: str  # SHA-256 of the source files of jaxhil and tuning
    versions: dict[str, str]  # versions of Python and of the dependencies
    xla_flags: str | None  # XLA flags that change rounding; None: any flags are allowed


def get_process_setting() -> ProcessSetting:
    """Return the code, package versions and XLA flags of this process."""
    return ProcessSetting(sources_sha256(), dependency_versions(), rounding_flags(active_xla_flags()))


def dask_setup(worker: Any) -> None:
    """Prepare JAX with the same flags as in a command; dask calls this when it preloads this module."""
    prepare_jax()


def run_pickled_call(content: bytes, asked: ProcessSetting | None) -> Any:
    """Call a pickled function with its pickled arguments; return the result.

    Raise `InputError` if code, package versions or XLA flags of this process differ from `asked`. The
    function's own exceptions are passed on.
    """
    with _run_lock:
        prepare_jax()
        if asked is not None:
            check_process_setting(asked, get_process_setting())
        function, arguments = pickle.loads(content)
        return function(*arguments)


def check_process_setting(asked: ProcessSetting, here: ProcessSetting) -> None:
    """Raise `InputError` if a worker's code, package versions or XLA flags, `here`, differ from `asked`."""
    for name in ProcessSetting._fields:
        actual, expected = getattr(here, name), getattr(asked, name)
        if actual == expected or expected is None:
            continue
        if name == "sources_sha256":
            raise build_setting_error(
                f"{name}: found {actual[:12]}, expected {expected[:12]} (a different version of jaxhil)",
                False,
            )
        raise build_setting_error(f"{name}: found {actual}, expected {expected}", name == "xla_flags")


def build_setting_error(difference: str, flags: bool) -> InputError:
    """Return the error for a worker with the `difference`; if `flags`, the message says how to start one."""
    advice = f"; start workers with: {PRELOAD_COMMAND}" if flags else ""
    return InputError(f"--scheduler: a worker: {difference}: its results would differ{advice}")
