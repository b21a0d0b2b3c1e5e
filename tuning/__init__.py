"""Tuning, verification and the command line, on top of `jaxhil`.

    import tuning

offers the functions behind the commands of the same names: `tune`, `sweep`, `compare`, `map`, `export`,
`verify` and `report`. Each function is imported on first use, so that this module does not import jax.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.front_door.compare import compare
    from tuning.front_door.export import export
    from tuning.front_door.map import map
    from tuning.front_door.report import report
    from tuning.front_door.sweep import sweep
    from tuning.front_door.tune import tune
    from tuning.front_door.verify import verify

__all__ = ["compare", "export", "map", "report", "sweep", "tune", "verify"]


def __getattr__(name: str) -> Any:
    """Import a public function on its first use, and store it in the module."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    function = getattr(import_module(f"{__name__}.front_door.{name}"), name)
    globals()[name] = function
    return function


def __dir__() -> list[str]:
    """Return the module's names, including the functions that are not imported yet."""
    return sorted({*globals(), *__all__})
