"""Code that runs on the workers of a dask.distributed cluster.

A worker imports this module with its first piece, and JAX only after the flags of JAX are set, as a command
does. If other code on the worker starts JAX earlier, this module has to be a preload: `PRELOAD_COMMAND`.
"""

import pickle
import threading
from typing import Any, NamedTuple

from jaxhil.errors import InputError
from jaxhil.simulation.jax_environment import active_xla_flags, prepare_jax, rounding_flags
from jaxhil.simulation.source_fingerprint import dependency_versions, sources_sha256

PRELOAD_COMMAND = "dask worker ADDRESS --preload tuning.caches.worker"

# A worker may have several threads, but only one program may run at a time.
_run_lock = threading.Lock()


class ProcessSetting(NamedTuple):
    """Properties of a process that affect the last bits of a result."""

    sources_sha256: str  # SHA-256 of the packages' files
    versions: dict[str, str]  # versions of Python and of the dependencies
    xla_flags: str | None  # flags of XLA that change rounding; None: any flags are allowed


def get_process_setting() -> ProcessSetting:
    """Return the setting of this process."""
    return ProcessSetting(sources_sha256(), dependency_versions(), rounding_flags(active_xla_flags()))


def dask_setup(worker: Any) -> None:
    """Start JAX with the flags of a command, when dask preloads this module."""
    prepare_jax()


def run_pickled_call(content: bytes, asked: ProcessSetting | None) -> Any:
    """Call a pickled function with its pickled arguments.

    Raise `InputError` if this process does not have the setting `asked`, and any exception of the function.
    """
    with _run_lock:
        prepare_jax()
        if asked is not None:
            check_process_setting(asked, get_process_setting())
        function, arguments = pickle.loads(content)
        return function(*arguments)


def check_process_setting(asked: ProcessSetting, here: ProcessSetting) -> None:
    """Raise `InputError` if the results of a worker may differ from those of the process that asks."""
    for name in ProcessSetting._fields:
        found, allowed = getattr(here, name), getattr(asked, name)
        if found == allowed or allowed is None:
            continue
        if name == "sources_sha256":
            raise build_setting_error(
                f"{name}: found {found[:12]}, expected {allowed[:12]} (another jaxhil)", False
            )
        raise build_setting_error(f"{name}: found {found}, expected {allowed}", name == "xla_flags")


def build_setting_error(what: str, flags: bool) -> InputError:
    """Return the error for a worker with another setting; if `flags` differ, it says how to start workers."""
    advice = f"; start workers by: {PRELOAD_COMMAND}" if flags else ""
    return InputError(f"--scheduler: a worker: {what}: its results would differ{advice}")
