"""Controller of the rig in plain Python: floats, a fixed order of operations, no JAX.

`Controller.from_file(path)` reads a gain file; `step` is then called once per control period. Importing this
package imports the compensators in the folders of `jaxhil.laws`, which register in `COMPENSATORS`. A bundle
contains controller, one compensator and the modules that they import in one file, `jaxhil_runtime.py`.
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
