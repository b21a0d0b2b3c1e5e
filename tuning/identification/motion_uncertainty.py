"""Effect of the uncertain motion simulator on the estimated parameters of the contact.

The fit of the contact takes the model of the motion simulator as exact. An error of this model displaces the
predicted mechanism, and the fit compensates for it: a motion that is too late makes the force delay too
short, and changes stiffness, damping and surface position as well. Many readings with little noise determine
the contact so precisely that these changes exceed the noise of the fit by far.

The contact is therefore fitted again with models that differ from the estimate by one standard deviation, in
one direction of the parameter space each. To first order, the effects of all directions add up. If a change
of the force delay alone compensates for all these differences, no fit is repeated. If the sensor has a lag,
linear least squares replace the fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tuning.identification.contact_fit import COARSE_GRID_SIZE, ContactFit
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import POSTERIOR_DRAWS, compute_posterior
from tuning.identification.deep_contact import LANES_PER_BLOCK, summarise_deep_lanes
from tuning.identification.free_motion import FreeMotion
from tuning.identification.motion import MotionResponse
from tuning.identification.normal_draws import factorise_covariance
from tuning.identification.rational import MotionModel
from tuning.identification.records import CampaignTiming, LoggedRun

TIME_CONSTANT_NAME, DAMPING_NAME = "time_constant", "damping"
# Norm of the change of all predicted readings [standard deviations of the noise]. Below it, no parameter
# changes by more than this share of its standard deviation.
MAX_CHANGE = 0.2
TIME_STEP = 1e-6  # step of finite differences with respect to the delay [s]
MIN_EIGENVALUE_RATIO = 1e-10  # minimum eigenvalue of a normal matrix, relative to the largest


def add_motion_uncertainty(
    contact: ContactFit | None,
    runs: Sequence[LoggedRun],
    motion: FreeMotion | None,
    timing: CampaignTiming,
    seed: int,
) -> tuple[ContactFit | None, np.ndarray | None]:
    """Draw the parameters of a fitted motion simulator, and add their effect to the draws of the contact.

    Args:
        contact: Fit of the contact with the estimated model of the motion simulator, or None.
        runs: Runs in contact.
        motion: Fit of the motion simulator, or None.
        timing: Timing of commands and readings.
        seed: Seed of the random numbers.

    Returns:
        The fit of the contact, with draws that correspond one by one to those of the motion simulator; and
        the deviations of these from the fitted parameters, shape (draws, parameters). Either may be None.
    """
    if motion is None:
        return contact, None
    factor = factorise_covariance(motion.covariance)
    normal = np.random.default_rng([seed, 1]).standard_normal((POSTERIOR_DRAWS, len(factor)))
    if contact is not None:
        effects = _compute_effects(contact, runs, motion.model, timing, factor, seed)
        shifts = _shift_draws(contact, (normal - normal.mean(axis=0)) @ effects)
        contact = replace(contact, motion_shifts=shifts)
    return contact, normal @ factor.T


def _shift_draws(contact: ContactFit, shifts: np.ndarray) -> np.ndarray:
    """Return the shifts of all draws; draws of a contact without damping remain undamped."""
    names = contact.posterior.names
    if DAMPING_NAME not in names:
        return shifts
    damping, shifts = names.index(DAMPING_NAME), shifts.copy()
    undamped = contact.posterior.draws[:, damping] == 0.0
    # The logs determine the difference of the force delay and the ratio of damping to stiffness.
    shifts[undamped, 0] -= shifts[undamped, damping] / contact.posterior.best[2].coefficients[0]
    shifts[undamped, damping] = 0.0
    return shifts


def _compute_effects(
    contact: ContactFit,
    runs: Sequence[LoggedRun],
    model: MotionModel,
    timing: CampaignTiming,
    factor: np.ndarray,
    seed: int,
) -> np.ndarray:
    """Return the change of the contact's parameters per column of `factor`, shape (columns, parameters)."""
    late = None if contact.drift is None else contact.drift.delays

    def respond(change: np.ndarray) -> MotionResponse:
        changed = replace(model, parameters=model.parameters + change)
        # A force delay that is longer or shorter by the difference of the motion's delays compensates for it.
        difference = abs(model.delay - changed.delay)
        longest = MAX_FORCE_DELAY + timing.control_period + difference
        return MotionResponse(changed, runs, timing, longest, late, contact.problem.min_delay - difference)

    if contact.problem.time_constant:
        return np.array([_linearise(contact, respond(column), respond(-column)) for column in factor.T])
    motions = [respond(column) for column in factor.T]
    delays, changes = _compensate_by_delay(contact, motions)
    if np.linalg.norm(changes) < MAX_CHANGE:
        effects = np.zeros((len(motions), len(contact.posterior.names)))
        effects[:, 0] = delays
        return effects
    usual = _refit(contact, contact.problem.motion, seed)
    return np.array([_refit(contact, motion, seed) - usual for motion in motions])


def _compensate_by_delay(
    contact: ContactFit, motions: Sequence[MotionResponse]
) -> tuple[np.ndarray, np.ndarray]:
    """Compensate for other motions of the mechanism by a change of the force delay alone.

    Returns:
        For each motion, the best change of the delay [s]; and the norm of the remaining change of all
        predicted readings, in standard deviations of the noise.
    """
    delay, plane, fit = contact.posterior.best
    usual = contact.problem.motion
    values = np.array([delay, plane, *fit.coefficients])
    by_delay = np.eye(len(values))[0]
    shifts = np.array([usual.delay - motion.delay for motion in motions])
    # Sums over all readings of the squared slope, the products with the slope, and the squared changes.
    slope_square, products, squares = 0.0, np.zeros(len(motions)), np.zeros(len(motions))
    for lanes in _divide_lanes(contact.readings.force.shape[1]):
        now = _predict(contact, usual.of(lanes), lanes, values)
        slope = (_predict(contact, usual.of(lanes), lanes, values + TIME_STEP * by_delay) - now) / TIME_STEP
        slope_square += float(slope @ slope)
        for i, (motion, shift) in enumerate(zip(motions, shifts, strict=True)):
            change = _predict(contact, motion.of(lanes), lanes, values + shift * by_delay) - now
            products[i] += slope @ change
            squares[i] += change @ change
    further = products / (slope_square or np.inf)
    return shifts - further, np.sqrt(np.maximum(squares - further * products, 0.0))


def _refit(contact: ContactFit, motion: MotionResponse, seed: int) -> np.ndarray:
    """Return the mean parameters of the contact with another motion and without a lag of the sensor.

    The likelihood has steps where rows come into contact, so that its derivatives do not help.
    """
    delay, plane, _ = contact.posterior.best
    near = delay + contact.problem.motion.delay - motion.delay, plane
    problem = ContactProblem(motion, contact.readings, contact.law, contact.problem.plane)
    return compute_posterior(summarise_deep_lanes(problem, near), seed, near, COARSE_GRID_SIZE).mean


def _linearise(contact: ContactFit, plus: MotionResponse, minus: MotionResponse) -> np.ndarray:
    """Return the change of the parameters that compensates for half the difference of `plus` and `minus`.

    A lag of the sensor smooths the force at the onset of contact, so that the predicted readings can be
    differentiated. The change of the parameters follows from linear least squares.
    """
    posterior = contact.posterior
    delay, plane, fit = posterior.best
    best = np.array([delay, plane, *fit.coefficients])
    if TIME_CONSTANT_NAME in posterior.names:
        best = np.append(best, contact.problem.time_constant)
    steps = posterior.draws.std(axis=0)
    varying = np.flatnonzero(steps > 0.0)
    normal, right = np.zeros((len(varying), len(varying))), np.zeros(len(varying))
    for lanes in _divide_lanes(contact.readings.force.shape[1]):
        usual, *others = (motion.of(lanes) for motion in (contact.problem.motion, plus, minus))
        columns = []
        for i in varying:
            change = np.zeros(len(best))
            change[i] = 0.5 * steps[i]
            columns.append(
                _predict(contact, usual, lanes, best + change)
                - _predict(contact, usual, lanes, best - change)
            )
        design = np.array(columns)
        high, low = (_predict(contact, motion, lanes, best) for motion in others)
        normal += design @ design.T
        right += design @ (low - high) / 2.0
    if contact.readings.bias is not None:
        bias = int(np.flatnonzero(varying == posterior.names.index("bias"))[0])
        normal[bias, bias] += (steps[varying[bias]] / contact.readings.bias[1]) ** 2
    result = np.zeros(len(best))
    result[varying] = np.linalg.pinv(normal, MIN_EIGENVALUE_RATIO, hermitian=True) @ right * steps[varying]
    return result


def _divide_lanes(count: int) -> Iterator[np.ndarray]:
    """Divide the lanes (runs) into blocks, which limit the memory."""
    yield from np.array_split(np.arange(count), -(-count // LANES_PER_BLOCK))


def _predict(contact: ContactFit, motion: MotionResponse, lanes: np.ndarray, values: np.ndarray):
    """Return the predicted readings of some lanes, whitened and divided by the noise's standard deviation."""
    size = len(contact.problem.names)
    delay, plane, coefficients = values[0], values[1], values[2 : 2 + size]
    lag = values[-1] if len(values) > 2 + size else contact.problem.time_constant
    readings = contact.readings.select_lanes(lanes)
    problem = ContactProblem(motion, readings, contact.law, contact.problem.plane, float(lag))
    force = problem.whiten(problem.force(float(delay), float(plane), coefficients)) / readings.std
    return force[readings.counts]
