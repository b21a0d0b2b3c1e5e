"""Code that runs on the workers of a dask.distributed cluster.

A worker imports this module with its first piece, and JAX only after the flags of JAX are set, as a command
does. If other code on the worker starts JAX earlier, this module has to be a preload: `PRELOAD`.
"""

import pickle
import threading
from typing import Any, NamedTuple

from jaxhil.errors import InputError
from jaxhil.simulation.environment import prepare, rounding_flags, xla_flags
from jaxhil.simulation.sources import sources_sha256, versions

PRELOAD = "dask worker ADDRESS --preload tuning.caches.worker"

# A worker may have several threads, but only one program may run at a time.
_one_at_a_time = threading.Lock()


class Setting(NamedTuple):
    """Properties of a process that affect the last bits of a result."""

    sources_sha256: str  # SHA-256 of the packages' files
    versions: dict[str, str]  # versions of Python and of the dependencies
    xla_flags: str | None  # flags of XLA that change rounding; None: any flags are allowed


def setting() -> Setting:
    """Return the setting of this process."""
    return Setting(sources_sha256(), versions(), rounding_flags(xla_flags()))


def dask_setup(worker: Any) -> None:
    """Start JAX with the flags of a command, when dask preloads this module."""
    prepare()


def run(content: bytes, asked: Setting | None) -> Any:
    """Call a pickled function with its pickled arguments.

    Raise `InputError` if this process does not have the setting `asked`, and any exception of the function.
    """
    with _one_at_a_time:
        prepare()
        if asked is not None:
            check_setting(asked, setting())
        function, arguments = pickle.loads(content)
        return function(*arguments)


def check_setting(asked: Setting, here: Setting) -> None:
    """Raise `InputError` if the results of a worker may differ from those of the process that asks."""
    for name in Setting._fields:
        found, allowed = getattr(here, name), getattr(asked, name)
        if found == allowed or allowed is None:
            continue
        if name == "sources_sha256":
            raise differs(f"{name}: found {found[:12]}, allowed {allowed[:12]} (another jaxhil)", False)
        raise differs(f"{name}: found {found}, allowed {allowed}", name == "xla_flags")


def differs(what: str, flags: bool) -> InputError:
    """Return the error for a worker with another setting; if `flags` differ, it says how to start workers."""
    advice = f"; start workers by: {PRELOAD}" if flags else ""
    return InputError(f"--scheduler: a worker: {what}: its results would differ{advice}")
