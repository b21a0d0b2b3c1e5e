"""Checks of an identification: of its mechanism file or, if there is no valid file, of its fits."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np

from jaxhil.errors import InputError
from jaxhil.mechanism.file import from_plain_data
from jaxhil.mechanism.structs import Mechanism
from tuning.identification import validation
from tuning.identification.contact_fit import ContactFit
from tuning.identification.contact_frequency import compute_force_lag
from tuning.identification.dead_zone_check import check_cut_dead_zone
from tuning.identification.free_motion import FreeMotion
from tuning.identification.mechanism_check import check_against_mechanism, check_file_uncertainty
from tuning.identification.mechanism_file import to_toml
from tuning.identification.motion_in_contact import check_motion_in_contact
from tuning.identification.options import IdentificationOptions
from tuning.identification.rational import MotionModel
from tuning.identification.records import CONTACT_KINDS, Campaign, LoggedRun
from tuning.identification.uncertainty_effect import compute_uncertainty_effect
from tuning.identification.unmodelled_effects import check_modelled_effects


def check_result(
    mechanism: dict[str, Any] | None,
    campaign: Campaign,
    motion: FreeMotion | None,
    contact: ContactFit | None,
    model: MotionModel | None,
    touching: list[LoggedRun],
    frequency: float,
    options: IdentificationOptions,
) -> tuple[dict[str, Any] | None, list[validation.CheckResult]]:
    """Check the mechanism file as `identify --check` does; if this is impossible, check the fits.

    Returns:
        The mechanism (None if it makes an invalid file), and the checks.
    """
    written, errors = _parse_written_mechanism(mechanism)
    lines = _check_written_file(campaign, written, motion if options.order is None else None)
    if lines is None:
        lines = [
            *errors,
            *_check_fits(motion, contact, model, touching, campaign.equivalent_mass, frequency, written),
        ]
    return None if errors else mechanism, lines


def _parse_written_mechanism(
    mechanism: dict[str, Any] | None,
) -> tuple[Mechanism | None, list[validation.CheckResult]]:
    """Read an identified mechanism back from its TOML text; if the text is invalid, return a failed check."""
    if mechanism is None:
        return None, []
    try:
        return from_plain_data(tomllib.loads(to_toml(mechanism)), "identified mechanism"), []
    except InputError as error:
        return None, [validation.CheckResult("mechanism file", str(error), True, 1.0)]


def _check_written_file(
    campaign: Campaign, written: Mechanism | None, motion: FreeMotion | None
) -> list[validation.CheckResult] | None:
    """Compare the logs with the identified mechanism file, as `identify --check` does.

    Args:
        campaign: The logs.
        written: The mechanism as read from this file, or None.
        motion: Fit of the motion simulator; None if there is none, or if the user specified its order.

    Returns:
        The checks; or None if there is no file, or if the logs cannot be compared with it.
    """
    if written is None or campaign.timing.two_clocks:
        return None
    if not any(run.kind in (*CONTACT_KINDS, "free") for run in campaign.runs):
        return None
    try:
        return list(check_against_mechanism(campaign, written, fitted=motion).lines)
    except InputError:
        return None


def _check_fits(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    model: MotionModel | None,
    touching: list[LoggedRun],
    mass: float,
    frequency: float,
    written: Mechanism | None,
) -> list[validation.CheckResult]:
    """Check the fits to free motion and to contact; `frequency` is the contact frequency [Hz]."""
    lines = [] if written is None else check_modelled_effects(written)
    if motion is not None:
        lines += [
            *validation.check_motion_model(motion, frequency),
            validation.check_delay_sign(motion, frequency),
        ]
    if contact is not None and model is not None:
        lag = compute_force_lag(contact, model, frequency)
        all_touches = np.ones(len(touching), bool)
        lines += [
            validation.check_stiffness_sign(contact),
            *validation.check_contact_model(contact, touching, mass, frequency, lag, all_touches),
            *check_motion_in_contact(contact, touching, frequency),
            *check_cut_dead_zone(contact, touching),
        ]
    if written is not None:
        lines += check_file_uncertainty(
            compute_uncertainty_effect(written), any(run.kind == "press" for run in touching)
        )
    return lines
