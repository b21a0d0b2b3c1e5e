"""Compensators, one folder each: `simulation.py` is the JAX version, `rig.py` the class that the rig runs.

`simulation_six_axes.py` and `rig_six_axes.py` are the versions for six axes of motion; a folder may contain
them alone, or in addition to the files for one axis. The files define which compensators exist; there is no
list of names. Each JAX file assigns the compensator to `COMPENSATOR`. `rig.py` registers its class with
`@register(NAME)`, and `rig_six_axes.py` with `@register_six_axes(NAME)`. The folder `shared` contains parts
that several compensators use. Importing this package, or any file of the rig, does not import JAX.
"""

from functools import cache
from pathlib import Path

_FOLDER = Path(__file__).parent
_FILES = {1: "simulation", 6: "simulation_six_axes"}  # number of axes: name of the module


@cache
def built_in_compensators(axes: int = 1) -> tuple[str, ...]:
    """Return the names of the built-in compensators: `none`, then all others in alphabetical order.

    Args:
        axes: number of axes of motion, 1 or 6.

    Example:
        >>> from jaxhil.laws import built_in_compensators
        >>> built_in_compensators(6)
        ('none', 'impulse_ledger', 'phase_lead', 'phase_lead_per_axis', 'response_error')
    """
    folders = sorted(path.parent.name for path in _FOLDER.glob(f"*/{_FILES[axes]}.py"))
    return tuple(sorted(folders, key=lambda name: name != "none"))


def module_name(name: str, axes: int = 1) -> str:
    """Return the full name of the Python module that contains a compensator's JAX version."""
    return f"{__name__}.{name}.{_FILES[axes]}"
