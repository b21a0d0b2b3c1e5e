"""How the tests' programs are compiled: quickly, but where a module is about the programs that users run.

A test's program runs once or twice: most of its time is the compiler's. With less optimisation that is a
third, for the same numbers but for their last bits, which are held to the same tolerances. Modules marked
`users_options`, and the studies and benchmarks that are no part of the everyday suite, have the options of
`tuning.environment`: where the last bits are what is tested, and where jax is held against the rig's own
controller.
"""

import functools

import jax
from jax._src import compiler

QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}

# Not public: a jax without it compiles everything with the users' options.
_given = getattr(compiler, "get_compile_options", None)
_quick = False


def _options(*arguments, env_options_overrides=None, **others):
    overrides = {**(QUICK if _quick else {}), **(env_options_overrides or {})}
    assert _given is not None
    return _given(*arguments, env_options_overrides=overrides, **others)


if _given is not None:
    compiler.get_compile_options = functools.wraps(_given)(_options)


def compile_quickly(quick: bool) -> None:
    """Whether what is compiled from here on is; no program made otherwise is used again."""
    global _quick
    if quick != _quick:
        jax.clear_caches()
        _quick = quick


def overridden() -> dict[str, object]:
    """Of the users' options, those that a program compiled now would have otherwise."""
    return dict(compiler.get_compile_options(1, 1).env_option_overrides)
