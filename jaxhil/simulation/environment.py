"""The settings of jax: devices, quick compilation, precision, and where compiled programs are kept.

A command has its process to itself: it calls `prepare` before anything that imports jax. A function called
from Python is a guest in its caller's process: it computes within `computing`, after which jax's settings and
the environment are the caller's again.
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

from jaxhil.simulation import startup
from jaxhil.simulation.compile_cache import keep_sealed

CACHE = "JAXHIL_CACHE"
# From which level on the compiler writes to standard error. That it takes long is an error to it;
# what goes wrong in it comes as an exception anyway.
LOG, FATAL = "TF_CPP_MIN_LOG_LEVEL", "3"
DEVICES = "--xla_force_host_platform_device_count"
SOME_DEVICES = re.compile(rf"{DEVICES}=[1-9]\d{{,2}}")
FEWEST_DEVICES = (
    2  # for one alone, the compiler orders sums otherwise: the last bits differ from those of more
)
# Tracing makes objects by the million, few of them in cycles: looking for those takes a tenth of the time of
# a short command.
RARELY = 100_000, 50, 50
# What compiled programs are kept under: all that takes longer to compile than to read.
KEEPING = {"jax_persistent_cache_min_compile_time_secs": 0.05, "jax_persistent_cache_min_entry_size_bytes": 0}
# Options of programs that run ticks, by this compiler's names: vectors as wide as the processor has, and
# fewer copies of what one tick hands to the next.
TICKS = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_copy_insertion_use_region_analysis": True}
# For a batch without derivatives each array is computed on its own, besides: twice as fast together. A
# Jacobian would take three times as long like that.
ROLLOUT = {**TICKS, "xla_disable_hlo_passes": "cpu_multi_output_fusion"}
# In six axes, of hundreds of arrays, by the older of the compiler's two ways to make loops: a tenth quicker.
SIX_AXES = {**ROLLOUT, "xla_cpu_use_fusion_emitters": False}
# Of what runs once and is soon done: compiled in half the time.
ONCE = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}
# An option of LLVM's own, to unroll loops as a whole or not at all, and the compiler's versions that it was
# tried with: an option that LLVM does not know ends the process.
WHOLE, TRIED = "-unroll-allow-partial=false", ("0.10.",)
# Modes for debugging, whatever JAX_... variables say: to them NaN would be a mistake, a program that is
# compiled before it runs is not there, and every transfer has to be explicit.
NO_DEBUGGING = {
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_disable_jit": False,
    "jax_no_tracing": False,
    "jax_transfer_guard": "allow",
}
_started_with: list[str] = []  # XLA_FLAGS that jax was started with, once `start` did it


def prepare() -> None:
    """For the rest of the process: float64, one device per usable core and two at least, quick compilation,
    compiled programs kept between calls.

    What the user says in XLA_FLAGS stands. Flags have no effect once jax runs, and are left alone then. Raise
    `InputError` if jax cannot be imported under the user's environment variables.
    """
    if "jax" not in sys.modules:
        os.environ.update(_checked_settings())
    gc.set_threshold(*RARELY)
    try:
        import jax
    except ValueError as error:
        raise startup.as_input_error(error) from None

    for name, value in {"jax_enable_x64": True, **NO_DEBUGGING}.items():
        if hasattr(jax.config, name):
            jax.config.update(name, value)
    named = program_folder()
    folder = named or cache_folder()
    if folder is not None and keep_sealed(folder) and not named:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        for name, value in KEEPING.items():
            jax.config.update(name, value)


@contextmanager
def computing() -> Iterator[None]:
    """Float64 and compiled programs kept, for the calls within and this thread; jax started, if it does not
    run yet, as for a command. Afterwards the caller's settings hold again."""
    start()
    collected = gc.get_threshold()
    try:
        gc.set_threshold(*RARELY)
        with float64(), _programs_kept():
            yield
    finally:
        gc.set_threshold(*collected)


def start() -> None:
    """Start jax as for a command, unless it runs already; the environment is then as it was.

    Raise `InputError` if jax cannot start.
    """
    startup.check_process()
    ours = _checked_settings()
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        import jax

        # The flags are read when the first device is asked for. Nothing happens if that was before, and then
        # there are as many devices as there were.
        count, named = jax.device_count(), ours["XLA_FLAGS"]
        if not _started_with and f"{DEVICES}={count}" in named.split():
            _started_with.append(named)
    except (AssertionError, RuntimeError, ValueError) as error:
        raise startup.as_input_error(error) from None
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def float64() -> Iterator[None]:
    """Float64 in this thread, and none of jax's debugging modes."""
    import jax

    with ExitStack() as stack:
        for setting in (
            *(jax.enable_x64(True), jax.debug_nans(False), jax.debug_infs(False), jax.disable_jit(False)),
            jax.transfer_guard("allow"),
        ):
            stack.enter_context(setting)
        yield


@contextmanager
def _programs_kept() -> Iterator[None]:
    """Compiled programs are kept in our folder, unless the caller keeps his somewhere."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    folder = None if program_folder() else cache_folder()
    if folder is None or not keep_sealed(folder):
        yield
        return
    ours = {"jax_compilation_cache_dir": str(folder), **KEEPING}
    before = {name: getattr(jax.config, name) for name in ours}
    try:
        for name, value in ours.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        # It would go on keeping the caller's programs otherwise.
        compilation_cache.reset_cache()


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
    return {"XLA_FLAGS": flags(given.get("XLA_FLAGS", "")), "NPROC": threads, LOG: given.get(LOG, FATAL)}


def _checked_settings() -> dict[str, str]:
    """`settings` of this process. Raise `InputError` for XLA_FLAGS over which XLA would end the process."""
    ours = settings(os.environ)
    harmless = flags("").split()
    tried = [
        flag
        for flag in ours["XLA_FLAGS"].split()
        if flag not in harmless and not SOME_DEVICES.fullmatch(flag)
    ]
    if tried:
        startup.check_flags(" ".join(tried))
    return ours


def xla_flags() -> str:
    """The flags that programs are compiled with here, as far as is known."""
    return _started_with[0] if _started_with else os.environ.get("XLA_FLAGS", "")


def rounding_flags(flags: str) -> str:
    """What of XLA_FLAGS may change the last bits of a result: all but how many devices, from two on."""
    alone = f"{DEVICES}=1"
    return " ".join(sorted(flag for flag in flags.split() if DEVICES not in flag or flag == alone))


def flags(given: str) -> str:
    """XLA_FLAGS: what the user gave, perhaps in a file, and what of ours it does not settle."""
    if given and not given.startswith("-"):
        given = startup.flags_of_file(given)
    ours = {
        DEVICES: max(FEWEST_DEVICES, usable_cores()),
        # A third of the compile time, for programs that run as fast.
        "--xla_backend_optimization_level": 1,
        # The tick's loop as one function, its arrays computed several at a time, instead of some 60 calls a
        # tick: half the time per tick, a third of that of a gradient, and half the compile time.
        "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1000000000,"
        "xla_cpu_use_multi_output_fusion",
    }
    if find_spec("jax_plugins") and os.environ.get("JAX_PLATFORMS") != "cpu":
        # A graphics card's programs would be optimised less, too; the other flags they do not know.
        del ours["--xla_backend_optimization_level"]
    elif version("jaxlib").startswith(TRIED):
        # After every loop that LLVM unrolls in part it forgets what it knows of all others around: with a law
        # of a thousand loops that is a third of the compile time, for programs that run as fast.
        ours["--xla_backend_extra_options"] += f",{WHOLE}"
    named = {flag.split("=")[0] for flag in given.split()}
    added = [f"{name}={value}" for name, value in ours.items() if name not in named]
    return " ".join([*given.split(), *added])


def known_options(options: Mapping[str, int | str]) -> dict[str, int | str]:
    """Those of a program's `compiler_options` that this version of the compiler has; for processors, all of
    them. It starts jax."""
    import jax

    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in options.items() if _is_known(name, value)}


@cache
def _is_known(name: str, value: int | str) -> bool:
    import jax

    try:
        jax.jit(lambda: 0, compiler_options={name: value})()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def usable_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


@contextmanager
def on_half_the_cores(half: int) -> Iterator[None]:
    """This thread runs on one half of the usable cores meanwhile, 0 or 1, where the system can be told so.

    The system leaves a thread on the core where it was. Work beside a program of all devices delays the same
    device again and again then, for which the others wait; in turns on both halves it delays all alike.
    """
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    own = sorted(usable)[half::2]
    try:
        _run_on(own)
        yield
    finally:
        _run_on(usable if own else ())


def _run_on(cores: Collection[int]) -> None:
    """This thread runs on these cores, if there are any and the system allows it."""
    with suppress(OSError):
        if cores:
            os.sched_setaffinity(0, cores)


def cache_folder() -> Path | None:
    """$JAXHIL_CACHE or ~/.cache/jaxhil, made if need be; None where it cannot be written."""
    try:
        folder = Path(os.environ.get(CACHE) or Path.home() / ".cache" / "jaxhil")
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, ValueError):
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None
