"""`jaxhil.simulate` of a mechanism of one axis or of six."""

import os
from collections.abc import Mapping
from typing import Any, overload

from jaxhil.mechanism.loading import as_any_mechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation import run
from jaxhil.simulation.run import Run
from jaxhil.sixdof.run import SixAxisRun, simulate_six_axes

Gains = Mapping[str, float] | str | os.PathLike[str] | None


@overload
def simulate(
    mechanism: Mechanism, compensator: str = "none", gains: Gains = None, *, seed: int = 0
) -> Run: ...
@overload
def simulate(
    mechanism: SixAxisMechanism, compensator: str = "none", gains: Gains = None, *, seed: int = 0
) -> SixAxisRun: ...
@overload
def simulate(
    mechanism: str | os.PathLike[str], compensator: str = "none", gains: Gains = None, *, seed: int = 0
) -> Any: ...
def simulate(
    mechanism: Mechanism | SixAxisMechanism | str | os.PathLike[str],
    compensator: str = "none",
    gains: Gains = None,
    *,
    seed: int = 0,
) -> Any:
    """Run the contacts of a mechanism once, as it is nominally; of six axes its episodes.

    `mechanism` is what `jaxhil.load` returns, the name of a built-in one, or a path. `compensator` is a law's
    name; in six axes "none", "phase_lead" or "phase_lead_per_axis". `gains` is None (what the literature's
    rules say), a dict of some of them (the others are the literature's), the name of one of the law's
    settings, or the path of a gain file; with a file, "none" stands for its law. `seed` is that of the
    sensors' noise.

    Raises `InputError`, one line, for whatever is wrong with them.
    """
    checked = as_any_mechanism(mechanism)
    if isinstance(checked, SixAxisMechanism):
        return simulate_six_axes(checked, compensator, gains, seed=seed)
    return run.simulate(checked, compensator, gains, seed=seed)
