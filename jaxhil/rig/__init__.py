"""The controller as it runs on the rig: plain Python floats, a fixed order of operations, no JAX.

`Controller.from_file(path)` reads a gain file and refuses one that does not fit; `step` is then called once
per control period. The compensators are found in the folders of `jaxhil.laws` and enter themselves in
`COMPENSATORS`. A bundle has controller, one compensator and their imports in one file, `jaxhil_runtime.py`.
"""

from importlib import import_module
from pathlib import Path

from jaxhil.rig.controller import Controller
from jaxhil.rig.errors import GainFileError
from jaxhil.rig.gain_file import digest
from jaxhil.rig.registry import COMPENSATORS

for _path in sorted((Path(__file__).parents[1] / "laws").glob("*/rig.py")):
    import_module(f"jaxhil.laws.{_path.parent.name}.rig")

__all__ = ["COMPENSATORS", "Controller", "GainFileError", "digest"]
