"""Compensators, one folder each: `simulation.py` is the JAX version, `rig.py` the class that the rig runs.

A compensator is found by its folder; no list names it. `simulation.py` binds the compensator to
`COMPENSATOR`, and `rig.py` registers its class with `@register(NAME)`. `AXES` in `__init__.py` lists the
numbers of axes of motion that the compensator serves, 1 or 6; the default is (1,). `shared` contains common
parts. Importing this package, or any `rig.py`, does not import JAX.
"""

from functools import cache
from importlib import import_module
from pathlib import Path

_FOLDER = Path(__file__).parent


@cache
def built_in_compensators(axes: int = 1) -> tuple[str, ...]:
    """Return the names of the compensators: `none`, then the others in alphabetical order.

    Args:
        axes: number of axes of motion, 1 or 6.

    Example:
        >>> from jaxhil.laws import built_in_compensators
        >>> built_in_compensators(6)
        ('none', 'phase_lead', 'phase_lead_per_axis')
    """
    folders = sorted(path.parent.name for path in _FOLDER.glob("*/simulation.py"))
    chosen = [name for name in folders if axes in getattr(import_module(f"{__name__}.{name}"), "AXES", (1,))]
    return tuple(sorted(chosen, key=lambda name: name != "none"))
