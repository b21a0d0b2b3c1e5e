"""What the caller of an identification knows or wants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxhil.errors import InputError, shown
from jaxhil.mechanism.structs import Mechanism
from tuning.caches.pieces import NOTHING_KEPT, Pieces
from tuning.identification.law_choice import NAMES
from tuning.identification.rational import STRUCTURES


@dataclass(frozen=True)
class Options:
    """What the caller knows or wants."""

    order: int | None = None  # of the motion simulator; None lets the lines choose
    law: str | None = None  # of the contact; None lets the touches choose
    fixed: Mapping[str, Any] = field(default_factory=dict)  # by key, a list's too: told, not estimated
    bayes: bool = False  # whether the prior's normal marginals are evidence beside the logs
    hold_out: float = 0.2  # share of the touches that judge the fit to the others
    bootstrap: int = 0  # fits to contacts drawn again, that widen intervals where contacts differ
    limit: float = 0.01  # on the restitution, of all that the model does not explain
    calibration: float = 0.001  # relative uncertainty of the force sensor's scale
    clock: float = 2e-5  # s, uncertainty of a delay that no log shows
    seed: int = 0
    scheduler: str | None = None  # address of that of a cluster whose workers do the bootstrap's fits
    kept: Pieces = NOTHING_KEPT  # of the bootstrap, those that are done


FEWEST_FITS = 20  # whose scatter says something
FIRST = ("rig.contact_plane", "rig.position_sensor.delay")  # told before anything is fitted


def check(options: Options, prior: Mechanism | None) -> None:
    """Raises `InputError` for options that cannot be."""
    for key in FIRST:
        if not isinstance(options.fixed.get(key, 0.0), (int, float)):
            raise InputError(f"fix: {key}: found {shown(options.fixed[key])}, allowed a number")
    if options.bayes and prior is None:
        raise InputError("bayes: found no prior, allowed a mechanism with [uncertainty]")
    if options.law is not None and options.law not in NAMES:
        raise InputError(f"law: found {shown(options.law)}, allowed {', '.join(NAMES)}")
    if 0 < options.bootstrap < FEWEST_FITS:
        raise InputError(f"bootstrap: found {options.bootstrap}, allowed 0, or {FEWEST_FITS} or more")
    orders = sorted({one.order for one in STRUCTURES})
    if options.order is not None and options.order not in orders:
        raise InputError(f"order: found {options.order}, allowed {', '.join(map(str, orders))}")
