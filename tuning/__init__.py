"""Tuning, verification and the command line, on top of `jaxhil`.

    import tuning

offers what the commands of these names do as functions: `tune`, `sweep`, `compare`, `map`, `export`,
`verify`, `report`. Each is loaded when it is first asked for: nothing here imports jax.
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
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.front_door.{name}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
