"""Tuning, verification and the command line, on top of `jaxhil`.

    import tuning

offers the functions behind the commands of the same names: `tune`, `sweep`, `compare`, `map`, `export`,
`verify` and `report`. Each function is imported on first use, so that this module does not import jax.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.api.compare import compare
    from tuning.api.export import export
    from tuning.api.map import map
    from tuning.api.report import report
    from tuning.api.sweep import sweep
    from tuning.api.tune import tune
    from tuning.api.verify import verify

__all__ = ["compare", "export", "map", "report", "sweep", "tune", "verify"]


def __getattr__(name: str) -> Any:
    """Import a public function on its first use, and store it in the module."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    function = getattr(import_module(f"{__name__}.api.{name}"), name)
    globals()[name] = function
    return function


def __dir__() -> list[str]:
    """Return the module's names, including the functions that are not imported yet."""
    return sorted({*globals(), *__all__})
