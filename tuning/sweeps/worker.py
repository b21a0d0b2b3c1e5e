"""Parts of sweeps on a worker of a dask.distributed cluster.

A worker imports this module when its first part comes, and jax after its flags are set, as a command does:
nothing here imports jax before. Where something else on the worker starts jax first, this module has to be
there before that, as a preload: `PRELOAD`.
"""

import threading
from functools import lru_cache
from typing import Any

from jaxhil.errors import InputError
from jaxhil.simulation.environment import prepare

PRELOAD = "dask worker ADDRESS --preload tuning.sweeps.worker"

# A worker may have several threads, and no two programs may run at a time.
_one_at_a_time = threading.Lock()


def dask_setup(worker: Any) -> None:
    """As a preload: jax is started with the flags of a command."""
    prepare()


def run_part(content: bytes, part: int) -> Any:
    """A part's rows, from the content of a manifest file. Raises `InputError` where they might differ from
    those of the process that asks."""
    with _one_at_a_time:
        prepare()
        from tuning.sweeps.chunks import run_chunk

        sweep = _sweep(content)
        return run_chunk(sweep, *sweep.manifest.part_rows(part))


@lru_cache(maxsize=2)
def _sweep(content: bytes) -> Any:
    from tuning.sweeps.chunks import build_sweep
    from tuning.sweeps.manifest import decode, unlike_here

    manifest = decode(content, "sweep")
    for differing in unlike_here(manifest):
        how = f"; start workers by: {PRELOAD}" if differing.startswith("xla_flags") else ""
        raise InputError(f"--scheduler: a worker: {differing}: its rows would differ{how}")
    return build_sweep(manifest)
