"""Compiler options of the tests: fast compilation, except in modules that test the programs of users.

A test's program runs once or twice, so most of its time is compilation. Reduced optimisation halves this time
and changes only the last bits of results, which must satisfy the same tolerances. Modules marked
`users_options`, slow tests and benchmarks use the options of `jaxhil.simulation.jax_environment`: they test
the last bits, or compare jax with the rig's controller.
"""

from pathlib import Path

import jax

from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, supported_options

# Options passed to `jax.jit` for a single program; most cannot be set for a whole module.
QUICK = supported_options(SINGLE_RUN_OPTIONS)

COMPILED = "/jax/core/compile/backend_compile_duration"

_quick = False
_made: list[str] = []


def compile_quickly(quick: bool) -> None:
    """Enable or disable fast compilation from now on; programs compiled before are not reused."""
    global _quick
    if quick != _quick:
        jax.clear_caches()
        jax.config.update("jax_disable_most_optimizations", quick)
        _quick = quick


def is_quick() -> bool:
    """Return whether programs are compiled with reduced optimisation."""
    return _quick


def _note(event: str, seconds: float, **details: str) -> None:
    if event == COMPILED:
        _made.append(details.get("fun_name", ""))


jax.monitoring.register_event_duration_secs_listener(_note)


def programs_of(function: str) -> int:
    """Return how many programs of a jitted function this process has compiled or read from the cache."""
    return sum(name in (function, f"jit({function})") for name in _made)


def forget_oldest(folder: Path, most: int) -> None:
    """Delete the least recently used cached programs until the given size in bytes is reached."""
    files = [(file.stat(), file) for file in folder.glob("*") if file.is_file()]
    files.sort(key=lambda entry: max(entry[0].st_atime, entry[0].st_mtime), reverse=True)
    total = 0
    for status, file in files:
        total += status.st_size
        if total > most:
            file.unlink(missing_ok=True)
