"""Compensators, a folder each: `simulation.py` is the law in JAX, `rig.py` the class that the rig runs.

A compensator is found by its folder; no list names it. `simulation.py` binds the law to `COMPENSATOR`, and
`rig.py` enters its class with `@register(NAME)`. `__init__.py`, which may be left out, states in `AXES` for
what motion the law is: along one axis (1), as is assumed without that, or in six (6). `shared` holds parts
that several laws have in common. Importing this package, or any `rig.py`, does not import JAX.
"""

from functools import cache
from importlib import import_module
from pathlib import Path

_FOLDER = Path(__file__).parent


@cache
def names(axes: int = 1) -> tuple[str, ...]:
    """Return the names of the compensators for one axis or for six: `none`, then the others by name.

    Example:
        >>> names(6)
        ('none', 'phase_lead', 'phase_lead_per_axis')
    """
    folders = sorted(path.parent.name for path in _FOLDER.glob("*/simulation.py"))
    found = [name for name in folders if axes in getattr(import_module(f"{__name__}.{name}"), "AXES", (1,))]
    return tuple(sorted(found, key=lambda name: name != "none"))
