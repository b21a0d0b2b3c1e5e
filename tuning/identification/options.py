"""Options of an identification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.structs import Mechanism
from tuning.caches.checkpoints import NO_CHECKPOINTS, Checkpoints
from tuning.identification.law_choice import FITTABLE_LAW_NAMES
from tuning.identification.rational import STRUCTURES


@dataclass(frozen=True)
class IdentificationOptions:
    """Options of an identification."""

    # order of the motion simulator, or None to choose the smallest order that explains the spectra
    order: int | None = None
    law: str | None = None  # name of the contact law, or None to choose the simplest law
    fixed: Mapping[str, Any] = field(default_factory=dict)  # fixed parameters by key: numbers or lists
    bayes: bool = False  # whether to combine the logs with the normal distributions of the prior
    hold_out: float = 0.2  # share of the contacts that a test fit omits; these contacts test the fit
    bootstrap: int = 0  # number of bootstrap fits; 0: no bootstrap
    limit: float = 0.01  # largest allowed effect of all defects on the restitution
    calibration: float = 0.001  # relative standard uncertainty of the force sensor's scale
    clock: float = 2e-5  # minimum standard uncertainty of a delay, because logs do not show clock errors [s]
    seed: int = 0  # seed of the random numbers
    scheduler: str | None = None  # address of a cluster's scheduler for the bootstrap
    checkpoints: Checkpoints = NO_CHECKPOINTS  # checkpoints of the bootstrap


MIN_BOOTSTRAP_FITS = 20  # minimum number of fits for an estimate of their scatter
# The fits use the fixed values of these parameters. The draws are conditioned on all other fixed values
# later.
KEYS_FIXED_BEFORE_FIT = ("rig.contact_plane", "rig.position_sensor.delay")


def check_options(options: IdentificationOptions, prior: Mechanism | None) -> None:
    """Raise `InputError` if the options are invalid."""
    for key in KEYS_FIXED_BEFORE_FIT:
        if not isinstance(options.fixed.get(key, 0.0), (int, float)):
            raise InputError(f"fix: {key}: found {format_value(options.fixed[key])}, expected a number")
    if options.bayes and prior is None:
        raise InputError("bayes: found no prior, expected a mechanism with [uncertainty]")
    if options.law is not None and options.law not in FITTABLE_LAW_NAMES:
        raise InputError(f"law: found {format_value(options.law)}, expected {', '.join(FITTABLE_LAW_NAMES)}")
    if 0 < options.bootstrap < MIN_BOOTSTRAP_FITS:
        raise InputError(f"bootstrap: found {options.bootstrap}, expected 0 or at least {MIN_BOOTSTRAP_FITS}")
    orders = sorted({structure.order for structure in STRUCTURES})
    if options.order is not None and options.order not in orders:
        raise InputError(f"order: found {options.order}, expected {', '.join(map(str, orders))}")
