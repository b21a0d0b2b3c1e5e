"""Functions to tune, evaluate and export compensators, and the command line `jaxhil`.

The functions `tune`, `sweep`, `compare`, `map`, `export`, `verify`, `shadow` and `report` do the work of the
commands with these names. Each function is imported when it is first used, so that `import tuning` does not
import jax.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.api.compare import compare
    from tuning.api.export import export
    from tuning.api.map import map
    from tuning.api.report import report
    from tuning.api.shadow import shadow
    from tuning.api.sweep import sweep
    from tuning.api.tune import tune
    from tuning.api.verify import verify

__all__ = ["compare", "export", "map", "report", "shadow", "sweep", "tune", "verify"]


def __getattr__(name: str) -> Any:
    """Import the public function `name` when it is first used, and store it in the module."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    function = getattr(import_module(f"{__name__}.api.{name}"), name)
    globals()[name] = function
    return function


def __dir__() -> list[str]:
    """Return the names in this module, including public functions that are not imported yet."""
    return sorted({*globals(), *__all__})
