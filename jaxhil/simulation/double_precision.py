"""Float64 for our computations, in a process whose jax is set up by somebody else.

The package computes in float64 alone. A command switches it on for its whole process; a function that is
called from Python is a guest there, and computes within `double_precision`.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import jax


@contextmanager
def double_precision() -> Iterator[None]:
    """Float64 in this thread, and none of jax's debugging modes, to which NaN would be a mistake; afterwards
    the caller's settings hold again."""
    with ExitStack() as settings:
        for setting in (jax.enable_x64(True), jax.debug_nans(False), jax.debug_infs(False)):
            settings.enter_context(setting)
        yield
