"""Public function `jaxhil.simulate`, for mechanisms with one axis or six axes."""

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
    """Simulate the nominal contacts of a mechanism on the rig once, with a compensator.

    Args:
        mechanism: Result of `jaxhil.load`, name of a built-in mechanism, or path of a mechanism file.
        compensator: Name of a compensator; with six axes "none", "phase_lead" or "phase_lead_per_axis".
            With a gain file, "none" stands for the compensator of the file.
        gains: None for the gains that the literature recommends. Alternatively a dict of gains by name
            (missing gains have the literature's values), the name of a setting of the compensator, or the
            path of a gain file.
        seed: Seed of the sensors' noise.

    Returns:
        A `Run` for a mechanism with one axis, or a `SixAxisRun` for a mechanism with six axes.

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
