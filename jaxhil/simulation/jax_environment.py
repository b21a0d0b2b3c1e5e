"""Settings of JAX: number of devices, fast compilation, precision, and the folder of compiled programs.

A command of the command line has its own process. The command calls `prepare_jax` before it imports any
module that imports JAX. A function of the Python interface runs in the process of its caller. The function
computes within `jax_context`, which restores the caller's settings of JAX and environment variables
afterwards.
"""

import gc
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from jaxhil.simulation import jax_startup
from jaxhil.simulation.compile_cache import use_checksummed_cache

CACHE_VARIABLE = "JAXHIL_CACHE"  # environment variable with the folder of compiled programs
# Minimum severity of XLA's messages on standard error. XLA reports slow compilation as an error, which would
# confuse users; real errors are also raised as exceptions.
LOG_LEVEL_VARIABLE, FATAL_LOG_LEVEL = "TF_CPP_MIN_LOG_LEVEL", "3"
DEVICE_COUNT_FLAG = "--xla_force_host_platform_device_count"
DEVICE_COUNT_PATTERN = re.compile(rf"{DEVICE_COUNT_FLAG}=[1-9]\d{{,2}}")
# With one device, XLA orders sums differently than with two or more, so that the last bits of results differ.
MIN_DEVICES = 2
# Thresholds of Python's garbage collector. Tracing creates millions of objects, of which few are in reference
# cycles. With the default thresholds, their collection costs 10 % of the time of a short command.
GC_THRESHOLDS = 100_000, 50, 50
# Settings with which JAX caches only programs that take longer to compile than to read from a file.
CACHE_SETTINGS = {
    "jax_persistent_cache_min_compile_time_secs": 0.05,
    "jax_persistent_cache_min_entry_size_bytes": 0,
}
# Compiler options of programs that run ticks: use the processor's widest vectors, and copy the state less
# often between ticks.
TICK_OPTIONS = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_copy_insertion_use_region_analysis": True}
# Compiler options of batches without derivatives: `TICK_OPTIONS`, and a separate loop for each array, which
# makes such a batch faster and a Jacobian slower.
ROLLOUT_OPTIONS = {**TICK_OPTIONS, "xla_disable_hlo_passes": "cpu_multi_output_fusion"}
# Compiler options for six axes: with hundreds of arrays, loops of XLA's older code generator are faster.
SIX_AXIS_OPTIONS = {**ROLLOUT_OPTIONS, "xla_cpu_use_fusion_emitters": False}
# Compiler options of programs with derivatives: the older code generator compiles them faster.
DERIVATIVE_OPTIONS = {**TICK_OPTIONS, "xla_cpu_use_fusion_emitters": False}
# Compiler options of short programs that run only once: these options reduce the compile time.
SINGLE_RUN_OPTIONS = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
# Option of LLVM to unroll loops completely or not at all, and versions of jaxlib for which the option was
# tested: an option that LLVM does not know would end the process.
FULL_UNROLL_OPTION, TESTED_JAXLIB_VERSIONS = "-unroll-allow-partial=false", ("0.10.",)
# Settings that switch off JAX's debugging modes, even if the user's environment variables request these
# modes. These modes treat NaN as an error, prevent compilation ahead of time, or forbid implicit transfers.
DEBUGGING_OFF = {
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_disable_jit": False,
    "jax_no_tracing": False,
    "jax_transfer_guard": "allow",
}
_startup_flags: list[str] = []  # XLA_FLAGS with which `start_jax` started JAX; empty if other code started it


def prepare_jax() -> None:
    """Set up JAX for the rest of the process.

    The settings are float64, one device per usable core but at least two, fast compilation, and a folder that
    caches compiled programs between processes. Flags in the user's XLA_FLAGS have priority. If JAX has
    already been imported, XLA_FLAGS stays unchanged, because JAX would ignore a change.

    Raise `InputError` if JAX cannot be imported with the user's environment variables.
    """
    if "jax" not in sys.modules:
        os.environ.update(_check_jax_variables())
    gc.set_threshold(*GC_THRESHOLDS)
    try:
        import jax
    except ValueError as error:
        raise jax_startup.convert_jax_error(error) from None

    for name, value in {"jax_enable_x64": True, **DEBUGGING_OFF}.items():
        if hasattr(jax.config, name):
            jax.config.update(name, value)
    named = program_folder()
    folder = named or cache_folder()
    if folder is not None and use_checksummed_cache(folder) and not named:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        for name, value in CACHE_SETTINGS.items():
            jax.config.update(name, value)


@contextmanager
def jax_context() -> Iterator[None]:
    """Use float64 and the folder of compiled programs within this context and thread.

    Start JAX unless it runs already (`start_jax`). Restore the caller's settings at the end of the context.
    """
    start_jax()
    thresholds = gc.get_threshold()
    try:
        gc.set_threshold(*GC_THRESHOLDS)
        with use_float64(), _cache_programs():
            yield
    finally:
        gc.set_threshold(*thresholds)


def start_jax() -> None:
    """Start JAX with the environment variables of `build_jax_variables`, unless it is already running.

    The caller's environment variables are restored afterwards.

    Raise `InputError` if JAX cannot start.
    """
    jax_startup.check_not_forked()
    ours = _check_jax_variables()
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        import jax

        # JAX reads the flags when a device is first used. If the caller had already used a device, our flags
        # have no effect. The number of devices then usually differs from the number in our flags.
        count, flags_text = jax.device_count(), ours["XLA_FLAGS"]
        if not _startup_flags and f"{DEVICE_COUNT_FLAG}={count}" in flags_text.split():
            _startup_flags.append(flags_text)
    except (AssertionError, RuntimeError, ValueError) as error:
        raise jax_startup.convert_jax_error(error) from None
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def use_float64() -> Iterator[None]:
    """Use float64 and no debugging modes of JAX within this context and thread."""
    import jax

    with ExitStack() as stack:
        for setting in (
            *(jax.enable_x64(True), jax.debug_nans(False), jax.debug_infs(False), jax.disable_jit(False)),
            jax.transfer_guard("allow"),
        ):
            stack.enter_context(setting)
        yield


@contextmanager
def _cache_programs() -> Iterator[None]:
    """Cache compiled programs in `cache_folder()` within this context, unless the caller has set a folder."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    folder = None if program_folder() else cache_folder()
    if folder is None or not use_checksummed_cache(folder):
        yield
        return
    ours = {"jax_compilation_cache_dir": str(folder), **CACHE_SETTINGS}
    before = {name: getattr(jax.config, name) for name in ours}
    try:
        for name, value in ours.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        # Without this reset, JAX would continue to cache the caller's programs in our folder.
        compilation_cache.reset_cache()


def program_folder() -> str | None:
    """Return the folder in which JAX caches compiled programs; None if no folder is set."""
    import jax

    return getattr(jax.config, "jax_compilation_cache_dir", None)


def build_jax_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables with which JAX is started, for the user's `environment`."""
    # XLA's devices share a pool of threads. A thread that splits a large task waits for a free thread. With
    # only one thread per device, all threads could wait forever.
    threads = environment.get("NPROC", str(4 * count_usable_cores()))
    return {
        "XLA_FLAGS": build_xla_flags(environment.get("XLA_FLAGS", "")),
        "NPROC": threads,
        LOG_LEVEL_VARIABLE: environment.get(LOG_LEVEL_VARIABLE, FATAL_LOG_LEVEL),
    }


def _check_jax_variables() -> dict[str, str]:
    """Return the environment variables with which JAX is started in this process.

    Raise `InputError` if XLA rejects the user's XLA_FLAGS; XLA itself would end the process.
    """
    ours = build_jax_variables(os.environ)
    default_flags = build_xla_flags("").split()
    unusual = [
        flag
        for flag in ours["XLA_FLAGS"].split()
        if flag not in default_flags and not DEVICE_COUNT_PATTERN.fullmatch(flag)
    ]
    if unusual:
        jax_startup.check_xla_flags(" ".join(unusual))
    return ours


def active_xla_flags() -> str:
    """Return the XLA_FLAGS with which `start_jax` started JAX; else the XLA_FLAGS of the environment."""
    return _startup_flags[0] if _startup_flags else os.environ.get("XLA_FLAGS", "")


def rounding_flags(flags: str) -> str:
    """Return a sorted text of the XLA flags that may change the last bits of a result.

    The flag for the number of devices is included only if the number is 1. All other flags are included.
    """
    alone = f"{DEVICE_COUNT_FLAG}=1"
    return " ".join(sorted(flag for flag in flags.split() if DEVICE_COUNT_FLAG not in flag or flag == alone))


def build_xla_flags(user_flags: str) -> str:
    """Return the value of XLA_FLAGS: the user's flags, completed with flags for fast programs.

    Args:
        user_flags: The user's XLA_FLAGS: flags, or the name of a file that contains flags.
    """
    if user_flags and not user_flags.startswith("-"):
        user_flags = jax_startup.read_xla_flags(user_flags)
    ours = {
        DEVICE_COUNT_FLAG: max(MIN_DEVICES, count_usable_cores()),
        # This level reduces the compile time to a third, and the programs are not slower.
        "--xla_backend_optimization_level": 1,
        # With these options, the loop over ticks becomes one function that computes several arrays at a time,
        # instead of about 60 function calls per tick. This halves run time and compile time, and divides the
        # time of a gradient by three.
        "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1000000000,"
        "xla_cpu_use_multi_output_fusion",
    }
    if find_spec("jax_plugins") and os.environ.get("JAX_PLATFORMS") != "cpu":
        # Unlike our other flags, this flag would also make programs on a graphics card slower.
        del ours["--xla_backend_optimization_level"]
    elif version("jaxlib").startswith(TESTED_JAXLIB_VERSIONS):
        # Each time LLVM unrolls a loop partially, LLVM repeats its analysis of the surrounding loops. For a
        # compensator with a thousand loops, this analysis takes a third of the compile time, and partial
        # unrolling does not make the program faster.
        ours["--xla_backend_extra_options"] += f",{FULL_UNROLL_OPTION}"
    user_names = {flag.split("=")[0] for flag in user_flags.split()}
    added = [f"{name}={value}" for name, value in ours.items() if name not in user_names]
    return " ".join([*user_flags.split(), *added])


def supported_options(options: Mapping[str, int | str]) -> dict[str, int | str]:
    """Return the compiler options that this version of XLA supports; none on graphics cards.

    This function starts JAX.
    """
    import jax

    if jax.default_backend() != "cpu":
        return {}
    items = tuple(options.items())
    # Every test compiles a program; usually one test of all options suffices.
    return dict(items if _are_supported(*items) else filter(_are_supported, items))


@cache
def _are_supported(*options: tuple[str, int | str]) -> bool:
    import jax

    try:
        jax.jit(lambda: 0, compiler_options=dict(options))()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def count_usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


@contextmanager
def use_half_the_cores(half: int) -> Iterator[None]:
    """Restrict this thread to one half of the usable cores within this context; `half` (0 or 1) selects it.

    This context is for a thread that works while a program runs on all devices. The operating system usually
    leaves a thread on its core. The thread then always delays the same device, and the other devices wait.
    Successive tasks should therefore alternate between both halves of the cores.
    """
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    cores = sorted(usable)[half::2]
    try:
        _restrict_to_cores(cores)
        yield
    finally:
        _restrict_to_cores(usable if cores else ())


def _restrict_to_cores(cores: Collection[int]) -> None:
    """Restrict this thread to a set of cores; do nothing if the set is empty or the system forbids this."""
    with suppress(OSError):
        if cores:
            os.sched_setaffinity(0, cores)


def cache_folder() -> Path | None:
    """Return the folder $JAXHIL_CACHE (default ~/.cache/jaxhil), created if missing; None if not writable."""
    try:
        folder = Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "jaxhil")
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, ValueError):
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None
