"""Conversion of a mechanism file to models of motion and contact, which are compared with logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxhil.contact import laws
from jaxhil.contact.base import ContactLaw
from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.structs import Contact, Mechanism, Simulator
from tuning.identification.contact_laws import Law
from tuning.identification.moving_average_model import MOVING_AVERAGE
from tuning.identification.rational import STRUCTURES, MotionModel, SimulatorStructure

# minimum ratio of imaginary part to magnitude of a complex pole; other poles are real except for rounding
REAL_POLE_TOLERANCE = 1e-9


def make_motion_model(mechanism: Mechanism) -> MotionModel:
    """Return the model of the motion simulator; its delay includes that of the position sensor."""
    simulator, total_delay = mechanism.rig.simulator, mechanism.rig.simulator.delay
    total_delay += mechanism.rig.position_sensor.delay
    if simulator.window is not None:
        return MOVING_AVERAGE.make_model(np.array([np.log(simulator.window), total_delay]))
    numerator, denominator = _get_transfer_function(simulator)
    poles = np.roots(denominator)
    real = np.abs(poles.imag) <= REAL_POLE_TOLERANCE * np.abs(poles)
    times = -1.0 / poles[real].real
    pairs = poles[~real & (poles.imag > 0.0)]
    sections = np.column_stack([np.abs(pairs), -pairs.real / np.abs(pairs)]).ravel()
    above = (np.asarray(numerator) / numerator[-1])[-2::-1]
    structure = SimulatorStructure(simulator.model, len(times), len(pairs), len(above))
    return MotionModel(structure, np.concatenate([np.log(times), np.log(sections), above, [total_delay]]))


def list_structures(mechanism: Mechanism | None) -> tuple[SimulatorStructure, ...]:
    """Return the model structures to fit to free motion: only the moving average if the mechanism has one."""
    is_average = mechanism is not None and mechanism.rig.simulator.window is not None
    return (MOVING_AVERAGE,) if is_average else STRUCTURES


def _get_transfer_function(simulator: Simulator) -> tuple[list[float], list[float]]:
    """Return the coefficients of the numerator and denominator of G(s) in descending powers of s."""
    if simulator.model == "first_order" and simulator.time_constant:
        return [1.0], [simulator.time_constant, 1.0]
    if simulator.model == "second_order" and simulator.natural_frequency and simulator.damping_ratio:
        w = 2.0 * np.pi * simulator.natural_frequency
        return [1.0], [1.0 / w**2, 2.0 * simulator.damping_ratio / w, 1.0]
    if simulator.model == "third_order" and simulator.coefficients:
        return [1.0], [*simulator.coefficients[::-1], 1.0]
    if simulator.model == "transfer_function" and simulator.numerator and simulator.denominator:
        return list(np.trim_zeros(simulator.numerator, "f")), list(simulator.denominator)
    return [1.0], [1.0]


def make_regression_law(contact: Contact) -> Law:
    """Return the contact law as a linear combination of regressors (functions of depth and rate).

    If contact parameters are lists, each list entry has its own coefficients.

    Raises:
        InputError: If the law's force is not a linear combination of functions of depth and rate.
    """
    chosen = laws.find_contact_law(contact.law)
    fitted = [
        name for name, law in laws.CONTACT_LAWS.items() if type(law).regression is not ContactLaw.regression
    ]
    # A user-registered law without a regression raises an error that names the missing method.
    if contact.law not in fitted and type(chosen).__module__.startswith("jaxhil."):
        raise InputError(f"contact.law: found {format_value(contact.law)}, expected {', '.join(fitted)}")
    law = chosen.regression(contact)

    def every(depth, rate):
        return [*law.entry_functions(depth, rate), *law.shared(depth, rate)]

    return replace(law, entry_functions=every, shared=lambda depth, rate: [])


def get_regression_coefficients(contact: Contact, entry: int) -> list[float]:
    """Return the contact law's regression coefficients for entry `entry` of the lists in `[contact]`."""
    stiffness = contact.stiffness[min(entry, len(contact.stiffness) - 1)]
    damping = contact.damping[min(entry, len(contact.damping) - 1)]
    return laws.find_contact_law(contact.law).coefficients(contact, stiffness, damping)
