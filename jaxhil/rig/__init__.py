"""Controller of the rig in plain Python: floats, a fixed order of operations, no JAX.

`Controller.from_file(path)` reads a gain file; the rig then calls `step` once per control period. Importing
this package imports the compensators in the folders of `jaxhil.laws`, which register in `COMPENSATORS`. The
file `jaxhil_runtime.py` of a bundle contains the controller, one compensator and all modules that they need.
`Controller6` is the controller of a rig with six axes (`jaxhil.rig.six_axes`).
"""

from importlib import import_module
from pathlib import Path
from typing import Any

from jaxhil.rig.controller import Controller
from jaxhil.rig.errors import GainFileError
from jaxhil.rig.gain_file import digest
from jaxhil.rig.registry import COMPENSATORS

for _path in sorted((Path(__file__).parents[1] / "laws").glob("*/rig.py")):
    import_module(f"jaxhil.laws.{_path.parent.name}.rig")


def __getattr__(name: str) -> Any:
    """Return `Controller6`, whose package is imported only if it is needed."""
    if name == "Controller6":
        return import_module("jaxhil.rig.six_axes").Controller6
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["COMPENSATORS", "Controller", "GainFileError", "digest"]
