"""What must be set before jax starts: devices, precision, and where compiled programs are kept.

Commands call `prepare` before anything that imports jax.
"""

import gc
import os
import sys
from collections.abc import Mapping
from pathlib import Path

CACHE = "JAXHIL_CACHE"


def prepare() -> None:
    """Float64, one device per usable core, quick compilation, compiled programs kept between calls.

    What the user says in XLA_FLAGS stands. Flags have no effect once jax runs, and are left alone then.
    """
    if "jax" not in sys.modules:
        os.environ.update(settings(os.environ))
    import jax

    # Tracing makes objects by the million, few of them in cycles: looking for those takes a tenth of the time
    # of a short command.
    gc.set_threshold(100_000, 50, 50)
    jax.config.update("jax_enable_x64", True)
    folder = cache_folder()
    if folder is not None and not program_folder():
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def program_folder() -> str | None:
    """Where compiled programs are kept, and what is kept beside them; None before `prepare`."""
    import jax

    return getattr(jax.config, "jax_compilation_cache_dir", None)


def settings(given: Mapping[str, str]) -> dict[str, str]:
    """Environment variables that jax reads when it starts, made of those `given`.

    XLA's devices share one pool of threads. One that cuts up a large piece of work waits for another thread
    to be free, and with no thread to spare all of them wait for ever.
    """
    threads = given.get("NPROC", str(4 * usable_cores()))
    return {"XLA_FLAGS": flags(given.get("XLA_FLAGS", "")), "NPROC": threads}


def flags(given: str) -> str:
    """XLA_FLAGS: what the user gave, and what of ours it does not settle."""
    ours = {
        "--xla_force_host_platform_device_count": usable_cores(),
        # A third of the compile time, for programs that run as fast.
        "--xla_backend_optimization_level": 1,
        # The tick's loop as one function, its arrays computed several at a time, instead of some 60 calls a
        # tick: half the time per tick, a third of that of a gradient, and half the compile time.
        "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1000000000,"
        "xla_cpu_use_multi_output_fusion",
    }
    named = {flag.split("=")[0] for flag in given.split()}
    added = [f"{name}={value}" for name, value in ours.items() if name not in named]
    return " ".join([*given.split(), *added])


def usable_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def cache_folder() -> Path | None:
    """$JAXHIL_CACHE or ~/.cache/jaxhil, made if need be; None where it cannot be written."""
    try:
        folder = Path(os.environ.get(CACHE) or Path.home() / ".cache" / "jaxhil")
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, ValueError):
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None
