"""Controller of a six-axis rig in plain Python: floats, a fixed order of operations, no JAX.

`Controller6.from_file(path)` reads a gain file; `step` is then called once per control period. Importing this
package imports the compensators in the folders of `jaxhil.laws`, which register in `SIX_AXIS_COMPENSATORS`.
"""

from importlib import import_module
from pathlib import Path

from jaxhil.rig.errors import GainFileError
from jaxhil.rig.gain_document import digest
from jaxhil.rig.six_axes.controller import Controller6
from jaxhil.rig.six_axes.registry import SIX_AXIS_COMPENSATORS, ModelConstants

for _path in sorted((Path(__file__).parents[2] / "laws").glob("*/rig_six_axes.py")):
    import_module(f"jaxhil.laws.{_path.parent.name}.rig_six_axes")

__all__ = ["SIX_AXIS_COMPENSATORS", "Controller6", "GainFileError", "ModelConstants", "digest"]
