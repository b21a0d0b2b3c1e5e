"""Closed forms for an uncompensated contact with a pure delay (notebooks/guide/model.md, section 6).

Items 1 and 2 of this section hold for linear contact without damping, and item 5 for Kelvin-Voigt contact.
All items assume a small control period, whose only effect is a mean delay (item 7).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import lambertw

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.scenario import Scenario

SERIES_TERMS = 40  # terms of the series; the first omitted term, 4.5^81/81!, is far below the rounding error
MAX_DELAY_PHASE = 1.0  # largest omega tau [rad]; the first zero of the series is then before 4.5/omega
TABLE_SIZE = 2049  # entries of the table of the series; linear interpolation has errors below 1e-6
INTEGRATOR_DELAYS = {"semi_implicit_euler": 0.0, "zoh": 0.5, "explicit_euler": 1.0}  # delay [control periods]


class ClosedForms(NamedTuple):
    """Values of the closed forms for each scenario of a batch; None for a form that does not apply."""

    series: np.ndarray | None  # restitution e from the series, item 1 [1]
    characteristic_root: np.ndarray | None  # restitution e from the dominant root, item 2 [1]
    # delay divided by the critical delay; above 1, the oscillation in contact grows, item 5 [1]
    delay_over_critical: np.ndarray | None
    reason: str | None  # reason if no closed form applies


def compute_closed_forms(mechanism: Mechanism, compensator: str, scenarios: Scenario) -> ClosedForms:
    """Compute the closed forms that apply to a batch of scenarios, for each scenario's stiffest contact."""
    reason = _reason_none_applies(mechanism, compensator, scenarios)
    if reason:
        return ClosedForms(None, None, None, reason)
    contacts = mechanism.approach.contacts
    stiffness = np.max(np.asarray(scenarios.contact.stiffness)[:contacts], axis=0)
    damping = np.max(np.asarray(scenarios.contact.damping)[:contacts], axis=0)
    mass, delay = np.asarray(scenarios.equivalent_mass), mean_delay(mechanism, scenarios)
    if np.all(damping > 0):
        return ClosedForms(None, None, delay / critical_delay(mass, stiffness, damping), None)
    phase = np.sqrt(stiffness / mass) * delay
    return ClosedForms(restitution_by_series(phase), restitution_by_root(phase), None, None)


def mean_delay(mechanism: Mechanism, scenarios: Scenario) -> np.ndarray:
    """Return the total mean delay [s] from motion to force of an uncompensated loop, (lanes,).

    The total is the sum of the transport delays of motion simulator and force sensor, and of the delays
    caused by integrator, command latency and hold, which are proportional to the control period.
    """
    rig = mechanism.rig
    periods = INTEGRATOR_DELAYS[rig.integrator] + rig.command_latency - 0.5 * (rig.command_hold == "zoh")
    sensed = np.asarray(scenarios.force_sensor.delay) + np.asarray(scenarios.simulator.delay)
    return sensed + periods * np.asarray(scenarios.control_period)


def restitution_by_series(phase: np.ndarray) -> np.ndarray:
    """Compute the restitution for x'' = -omega^2 x(t - tau) by a series; `phase` is omega tau [rad].

    With time in units of 1/omega, the motion is S(t) = sum_n (-1)^n (t - n tau)^(2n+1)/(2n+1)!. The delayed
    force acts until the time tau after the first zero t_s of S, so that the restitution is |S'(t_s + tau)|.
    The result is NaN unless 0 <= phase <= 1.
    """
    table = np.linspace(0.0, MAX_DELAY_PHASE, TABLE_SIZE)
    low, high = np.full_like(table, 2.0), np.full_like(table, 4.5)
    for _ in range(50):
        middle = (low + high) / 2
        before = _series_motion(middle, table, 0) > 0
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    rebound = np.abs(_series_motion(low + table, table, 1))
    phase = np.asarray(phase, float)
    return np.where((phase >= 0) & (phase <= MAX_DELAY_PHASE), np.interp(phase, table, rebound), np.nan)


def restitution_by_root(phase: np.ndarray) -> np.ndarray:
    """Estimate the restitution for x'' = -omega^2 x(t - tau) from a root; `phase` is omega tau [rad].

    The dominant root s = (2/tau) W_0(j omega tau/2) of s^2 = -omega^2 e^(-s tau) gives the restitution exp(pi
    Re s/|Im s|). W_0 is the principal branch of the Lambert function. The result is NaN for a negative phase.
    """
    phase = np.asarray(phase, float)
    root = lambertw(0.5j * np.where(phase > 0, phase, 1.0))
    with np.errstate(divide="ignore"):
        grown = np.exp(math.pi * root.real / np.abs(root.imag))
    return np.where(phase > 0, grown, np.where(phase == 0, 1.0, np.nan))


def critical_delay(mass: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the critical delay [s]: for a longer delay tau, the oscillation in contact grows.

    The equation of motion is M x'' + b x'(t - tau) + k x(t - tau) = 0.
    """
    square = (damping**2 + np.sqrt(damping**4 + 4 * mass**2 * stiffness**2)) / (2 * mass**2)
    frequency = np.sqrt(square)
    return np.arctan(damping * frequency / stiffness) / frequency


def _reason_none_applies(mechanism: Mechanism, compensator: str, scenarios: Scenario) -> str | None:
    """Return the reason why no closed form applies to the scenarios, or None if a closed form applies."""
    damping = np.asarray(scenarios.contact.damping)[: mechanism.approach.contacts]
    if compensator != "none":
        return "the contact is compensated"
    if not find_contact_law(mechanism.contact.law).is_linear:
        return f"the contact law is {mechanism.contact.law}"
    if mechanism.rig.simulator.model != "ideal":
        return f"the motion simulator is {mechanism.rig.simulator.model}"
    if scenarios.timing is not None:
        return "the timing varies from tick to tick"
    if np.any(np.asarray(scenarios.force_sensor.time_constant) > 0):
        return "the force sensor has a lag"
    if np.any(np.isfinite(np.asarray(scenarios.clearance))):
        return "there are two surfaces"
    if np.any(damping > 0) and not np.all(damping > 0):
        return "some contacts are damped and some are not"
    return None


def _series_motion(time: np.ndarray, delay: np.ndarray, derivative: int) -> np.ndarray:
    """Return the motion S(t) of `restitution_by_series`, or a derivative of it, elementwise."""
    total = np.zeros_like(time)
    for n in range(SERIES_TERMS):
        power = 2 * n + 1 - derivative
        since = np.maximum(time - n * delay, 0.0)
        term = since**power / math.factorial(power)
        total += np.where(time > n * delay, (-1) ** n * term, 0.0)
    return total
