"""`jaxhil.simulate` for mechanisms of one axis or of six axes."""

import os
from collections.abc import Mapping
from typing import Any, overload

from jaxhil.mechanism.loading import as_any_mechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation import run
from jaxhil.simulation.run import Run
from jaxhil.sixdof.run import SixAxisRun, simulate_six_axes

GainChoice = Mapping[str, float] | str | os.PathLike[str] | None


@overload
def simulate(
    mechanism: Mechanism, compensator: str = "none", gains: GainChoice = None, *, seed: int = 0
) -> Run: ...
@overload
def simulate(
    mechanism: SixAxisMechanism, compensator: str = "none", gains: GainChoice = None, *, seed: int = 0
) -> SixAxisRun: ...
@overload
def simulate(
    mechanism: str | os.PathLike[str], compensator: str = "none", gains: GainChoice = None, *, seed: int = 0
) -> Any: ...
def simulate(
    mechanism: Mechanism | SixAxisMechanism | str | os.PathLike[str],
    compensator: str = "none",
    gains: GainChoice = None,
    *,
    seed: int = 0,
) -> Any:
    """Run the contacts of a nominal mechanism once; with six axes, its episodes.

    Args:
        mechanism: Result of `jaxhil.load`, name of a built-in mechanism, or path.
        compensator: Name of a compensator; with six axes "none", "phase_lead" or "phase_lead_per_axis".
        gains: None for the literature's gains, a dict of some gains (the others are the literature's), the
            name of one of the compensator's settings, or the path of a gain file; with a file, the
            compensator "none" means that of the file.
        seed: Seed of the sensors' noise.

    Returns:
        A `Run`, or a `SixAxisRun` for six axes.

    Raises:
        InputError: An argument is invalid.

    Example:
        >>> import jaxhil
        >>> run = jaxhil.simulate("rig-300kg", "phase_lead", {"phase_lead": 0.028})
        >>> round(run.contacts[0].restitution, 2)
        1.13
    """
    checked = as_any_mechanism(mechanism)
    if isinstance(checked, SixAxisMechanism):
        return simulate_six_axes(checked, compensator, gains, seed=seed)
    return run.simulate(checked, compensator, gains, seed=seed)
