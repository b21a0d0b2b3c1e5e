"""Frequency of the contact, and lag of the force reading at a frequency."""

from __future__ import annotations

import numpy as np

from tuning.identification.contact_fit import ContactFit
from tuning.identification.rational import MotionModel

ASSUMED_CONTACT_FREQUENCY = 3.0  # contact frequency that is assumed if the logs have no contact [Hz]


def estimate_contact_frequency(contact: ContactFit | None, mass: float) -> float:
    """Return the contact frequency [Hz] of the stiffest contact, from its secant stiffness at full depth.

    If `contact` is None, because the logs have no contact, return an assumed value.
    """
    if contact is None:
        return ASSUMED_CONTACT_FREQUENCY
    delay, plane, fit = contact.posterior.best
    position, _ = contact.problem.motion.at(delay)
    depth = np.where(contact.readings.counts, position - plane, 0.0)
    # The last coefficient is the bias of the sensor or a dead zone, which the prediction includes.
    force = contact.problem.force(delay, plane, fit.coefficients) - fit.coefficients[-1]
    force = np.where(contact.readings.counts & (depth > 0.0), force, 0.0)
    deepest, lanes = np.argmax(depth, axis=0), np.arange(depth.shape[1])
    peak = force[deepest, lanes]
    # If the force of a contact is very small, noise dominates its secant stiffness.
    secant = np.where(peak > 0.2 * peak.max(), peak / np.maximum(depth[deepest, lanes], 1e-9), 0.0)
    return float(np.sqrt(max(secant.max(), 1e-9) / mass) / (2.0 * np.pi))


def compute_force_lag(contact: ContactFit, model: MotionModel, frequency: float) -> float:
    """Return the phase delay [s] from the command to the force reading at a frequency [Hz]."""
    angle = float(np.angle(model.response(np.array([2j * np.pi * frequency]))[0]))
    filter_delay = contact.problem.time_constant * contact.readings.modes.delay
    return contact.posterior.best[0] + filter_delay - angle / (2.0 * np.pi * frequency)
