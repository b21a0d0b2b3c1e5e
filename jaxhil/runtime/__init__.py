"""The controller as it runs on the rig: plain Python floats, a fixed order of operations, no jax.

`Controller.from_file(path)` reads a gain file and refuses one that does not fit; `step` is then
called once per control period. Each compensator is one file of `laws`, and enters itself in
`registry.COMPENSATORS`, so that a bundle may concatenate `controller`, one compensator and what
the two import, and nothing else.
"""

from importlib import import_module

from .controller import Controller
from .errors import GainFileError
from .gain_file import digest
from .laws import LAWS
from .registry import COMPENSATORS

for _law in LAWS:
    import_module(f".laws.{_law}", __name__)

__all__ = ["COMPENSATORS", "Controller", "GainFileError", "digest"]
