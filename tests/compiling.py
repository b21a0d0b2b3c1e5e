"""How the tests' programs are compiled: quickly, but where a module is about the programs that users run.

A test's program runs once or twice: most of its time is the compiler's. With less optimisation that is half,
for the same numbers but for their last bits, which are held to the same tolerances. Modules marked
`users_options`, and the studies and benchmarks that are no part of the everyday suite, have the options of
`jaxhil.simulation.jax_environment`: where the last bits are what is tested, and where jax is held against the
rig's own controller.
"""

from pathlib import Path

import jax

from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, supported_options

# Of one program, given to `jax.jit`: more than can be switched for all that a module compiles.
QUICK = supported_options(SINGLE_RUN_OPTIONS)

COMPILED = "/jax/core/compile/backend_compile_duration"

_quick = False
_made: list[str] = []


def compile_quickly(quick: bool) -> None:
    """Whether what is compiled from here on is; no program made otherwise is used again."""
    global _quick
    if quick != _quick:
        jax.clear_caches()
        jax.config.update("jax_disable_most_optimizations", quick)
        _quick = quick


def is_quick() -> bool:
    """Whether programs compiled now are compiled quickly."""
    return _quick


def _note(event: str, seconds: float, **details: str) -> None:
    if event == COMPILED:
        _made.append(details.get("fun_name", ""))


jax.monitoring.register_event_duration_secs_listener(_note)


def programs_of(function: str) -> int:
    """How many programs of a jitted function were made in this process, compiled or from the cache."""
    return sum(name in (function, f"jit({function})") for name in _made)


def forget_oldest(folder: Path, most: int) -> None:
    """Leave of the kept programs those used last, in all so many bytes."""
    files = [(file.stat(), file) for file in folder.glob("*") if file.is_file()]
    files.sort(key=lambda entry: max(entry[0].st_atime, entry[0].st_mtime), reverse=True)
    total = 0
    for status, file in files:
        total += status.st_size
        if total > most:
            file.unlink(missing_ok=True)
