"""What a worker of a dask.distributed cluster does.

A worker imports this module when its first piece comes, and jax after its flags are set, as a command does:
nothing here imports jax before. Where something else on the worker starts jax first, this module has to be
there before that, as a preload: `PRELOAD`.
"""

import pickle
import threading
from typing import Any, NamedTuple

from jaxhil.errors import InputError
from jaxhil.simulation.environment import prepare, rounding_flags, xla_flags
from jaxhil.simulation.sources import sources_sha256, versions

PRELOAD = "dask worker ADDRESS --preload tuning.caches.worker"

# A worker may have several threads, and no two programs may run at a time.
_one_at_a_time = threading.Lock()


class Setting(NamedTuple):
    """What decides the last bits of a result beside what it is asked of."""

    sources_sha256: str  # of the packages' files
    versions: dict[str, str]  # of what they stand on
    xla_flags: str | None  # those that change rounding; None: they change nothing


def setting() -> Setting:
    """That of this process."""
    return Setting(sources_sha256(), versions(), rounding_flags(xla_flags()))


def dask_setup(worker: Any) -> None:
    """As a preload: jax is started with the flags of a command."""
    prepare()


def run(content: bytes, asked: Setting | None) -> Any:
    """What a pickled function makes of its arguments. Raises what that does, and `InputError` where this
    process is not as `asked` says."""
    with _one_at_a_time:
        prepare()
        if asked is not None:
            check_setting(asked, setting())
        function, arguments = pickle.loads(content)
        return function(*arguments)


def check_setting(asked: Setting, here: Setting) -> None:
    """Raises `InputError` where a worker's results may differ from those of the process that asks."""
    for name in Setting._fields:
        found, allowed = getattr(here, name), getattr(asked, name)
        if found == allowed or allowed is None:
            continue
        if name == "sources_sha256":
            raise differs(f"{name}: found {found[:12]}, allowed {allowed[:12]} (another jaxhil)", False)
        raise differs(f"{name}: found {found}, allowed {allowed}", name == "xla_flags")


def differs(what: str, flags: bool) -> InputError:
    """A worker that is not as its asker; where its flags are others, how to start it."""
    how = f"; start workers by: {PRELOAD}" if flags else ""
    return InputError(f"--scheduler: a worker: {what}: its results would differ{how}")
