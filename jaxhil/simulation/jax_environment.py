"""Settings of JAX: devices, fast compilation, precision, and the folder of compiled programs.

A command has its own process: it calls `prepare_jax` before importing anything that imports JAX. A function
called from Python runs in its caller's process: it computes within `jax_context`, which restores the settings
of JAX and the environment afterwards.
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

CACHE_VARIABLE = "JAXHIL_CACHE"
# Least level of the compiler's messages on standard error. It reports slow compilation as an error; real
# errors are raised as exceptions anyway.
LOG_LEVEL_VARIABLE, FATAL_LOG_LEVEL = "TF_CPP_MIN_LOG_LEVEL", "3"
DEVICE_COUNT_FLAG = "--xla_force_host_platform_device_count"
DEVICE_COUNT_PATTERN = re.compile(rf"{DEVICE_COUNT_FLAG}=[1-9]\d{{,2}}")
# For one device the compiler orders sums differently: the last bits differ from those of two or more.
MIN_DEVICES = 2
# Thresholds of garbage collection. Tracing creates millions of objects, few of them in cycles: the default
# thresholds cost 10 % of the time of a short command.
GC_THRESHOLDS = 100_000, 50, 50
# Programs are cached if they take longer to compile than to read.
CACHE_SETTINGS = {
    "jax_persistent_cache_min_compile_time_secs": 0.05,
    "jax_persistent_cache_min_entry_size_bytes": 0,
}
# Compiler options of programs that run ticks: the processor's widest vectors, and fewer copies of the state
# between ticks.
TICK_OPTIONS = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_copy_insertion_use_region_analysis": True}
# Options of batches without derivatives: each array is also computed separately. Together this is twice as
# fast, but a Jacobian would take three times as long.
ROLLOUT_OPTIONS = {**TICK_OPTIONS, "xla_disable_hlo_passes": "cpu_multi_output_fusion"}
# Options for six axes, with hundreds of arrays: the older of two loop emitters is 10 % faster.
SIX_AXIS_OPTIONS = {**ROLLOUT_OPTIONS, "xla_cpu_use_fusion_emitters": False}
# Options of short programs that run once: they compile in half the time.
SINGLE_RUN_OPTIONS = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}
# An option of LLVM, to unroll loops completely or not at all, and the tested versions of the compiler: an
# option that LLVM does not have ends the process.
FULL_UNROLL_OPTION, TESTED_JAXLIB_VERSIONS = "-unroll-allow-partial=false", ("0.10.",)
# Debugging modes are off, whatever JAX_... variables say: they treat NaN as an error, prevent compilation
# ahead of time, or require explicit transfers.
DEBUGGING_OFF = {
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_disable_jit": False,
    "jax_no_tracing": False,
    "jax_transfer_guard": "allow",
}
_started_with: list[str] = []  # XLA_FLAGS with which `start_jax` started JAX


def prepare_jax() -> None:
    """Set up JAX for the rest of the process.

    This means float64, one device per usable core but at least two, fast compilation, and compiled programs
    cached between calls. Flags in the user's XLA_FLAGS have priority. Flags have no effect once JAX runs, and
    are not changed then. Raise `InputError` if JAX cannot be imported with the user's environment variables.
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
    """Use float64 and cached programs within this context and thread.

    Start JAX as for a command, unless it runs already. The caller's settings are restored afterwards.
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
    """Start JAX as for a command, unless it runs already; restore the environment variables afterwards.

    Raise `InputError` if JAX cannot start.
    """
    jax_startup.check_not_forked()
    ours = _check_jax_variables()
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        import jax

        # JAX reads the flags at the first use of a device. If that was earlier, they have no effect and the
        # number of devices may be another one.
        count, flags_text = jax.device_count(), ours["XLA_FLAGS"]
        if not _started_with and f"{DEVICE_COUNT_FLAG}={count}" in flags_text.split():
            _started_with.append(flags_text)
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
    """Use float64 in this thread, without JAX's debugging modes."""
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
    """Cache compiled programs in our folder, unless the caller has a folder for them."""
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
        # Otherwise JAX would continue to cache the caller's programs in our folder.
        compilation_cache.reset_cache()


def program_folder() -> str | None:
    """Return the folder of compiled programs and related files; None before `prepare_jax`."""
    import jax

    return getattr(jax.config, "jax_compilation_cache_dir", None)


def build_jax_variables(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that JAX reads at its start, made from the variables `given`.

    XLA's devices share one pool of threads. A thread that splits a large task waits for another one to be
    free; without spare threads all of them would wait forever.
    """
    threads = given.get("NPROC", str(4 * count_usable_cores()))
    return {
        "XLA_FLAGS": build_xla_flags(given.get("XLA_FLAGS", "")),
        "NPROC": threads,
        LOG_LEVEL_VARIABLE: given.get(LOG_LEVEL_VARIABLE, FATAL_LOG_LEVEL),
    }


def _check_jax_variables() -> dict[str, str]:
    """Return `build_jax_variables` of this process; raise `InputError` for XLA_FLAGS that would end it."""
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
    """Return the flags with which programs are compiled here, as far as known."""
    return _started_with[0] if _started_with else os.environ.get("XLA_FLAGS", "")


def rounding_flags(flags: str) -> str:
    """Return those XLA_FLAGS that may change the last bits of a result.

    These are all flags except a number of devices of two or more.
    """
    alone = f"{DEVICE_COUNT_FLAG}=1"
    return " ".join(sorted(flag for flag in flags.split() if DEVICE_COUNT_FLAG not in flag or flag == alone))


def build_xla_flags(given: str) -> str:
    """Return XLA_FLAGS: the user's flags, which may be in a file, and our flags that the user did not set."""
    if given and not given.startswith("-"):
        given = jax_startup.read_xla_flags(given)
    ours = {
        DEVICE_COUNT_FLAG: max(MIN_DEVICES, count_usable_cores()),
        # Compilation takes a third of the time; the programs are as fast.
        "--xla_backend_optimization_level": 1,
        # The tick's loop becomes one function that computes several arrays at a time, instead of about 60
        # calls a tick: half the time per tick, a third of a gradient's time, and half the compile time.
        "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1000000000,"
        "xla_cpu_use_multi_output_fusion",
    }
    if find_spec("jax_plugins") and os.environ.get("JAX_PLATFORMS") != "cpu":
        # This flag, unlike the others, would also reduce the optimisation of a graphics card's programs.
        del ours["--xla_backend_optimization_level"]
    elif version("jaxlib").startswith(TESTED_JAXLIB_VERSIONS):
        # LLVM discards its analysis of the surrounding loops after each loop that it unrolls partially. With
        # a law of a thousand loops this is a third of the compile time; the programs are not faster.
        ours["--xla_backend_extra_options"] += f",{FULL_UNROLL_OPTION}"
    user_names = {flag.split("=")[0] for flag in given.split()}
    added = [f"{name}={value}" for name, value in ours.items() if name not in user_names]
    return " ".join([*given.split(), *added])


def supported_options(options: Mapping[str, int | str]) -> dict[str, int | str]:
    """Return those of a program's `compiler_options` that this version of the compiler has.

    On graphics cards there are none. This starts JAX.
    """
    import jax

    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in options.items() if _is_supported(name, value)}


@cache
def _is_supported(name: str, value: int | str) -> bool:
    """Return whether the compiler accepts an option."""
    import jax

    try:
        jax.jit(lambda: 0, compiler_options={name: value})()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def count_usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


@contextmanager
def use_half_the_cores(half: int) -> Iterator[None]:
    """Restrict this thread to half of the usable cores (0 or 1), if the system allows it.

    The system leaves a thread on its core. Work beside a program of all devices would therefore delay the
    same device repeatedly, for which the others wait. Alternating between both halves delays all devices
    equally.
    """
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    cores = sorted(usable)[half::2]
    try:
        _restrict_to_cores(cores)
        yield
    finally:
        _restrict_to_cores(usable if cores else ())


def _restrict_to_cores(cores: Collection[int]) -> None:
    """Restrict this thread to these cores, if there are any and the system allows it."""
    with suppress(OSError):
        if cores:
            os.sched_setaffinity(0, cores)


def cache_folder() -> Path | None:
    """Return $JAXHIL_CACHE or ~/.cache/jaxhil, created if necessary; None if it cannot be written."""
    try:
        folder = Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "jaxhil")
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, ValueError):
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None
