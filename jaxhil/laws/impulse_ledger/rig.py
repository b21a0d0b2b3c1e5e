"""Impulse ledger: a reference trajectory at the time of the force readings, predicted to the present.

A force reading is the force that should have acted on the numerical model a time D earlier. D is the lag of
hardware and force measurement behind the model, measured in free flight immediately before the onset. The
compensator has four steps:

1. Fit a contact model to the readings (`contact_model`).
2. Advance a reference trajectory at the time of the readings (`reference_trajectory`).
3. Predict the trajectory from this time to the present, D later, with the fitted model.
4. Control the numerical model's velocity to follow the prediction:

    F_c = f_p + clip(c (v_d - T f_p/2 - v_p), -limit p, (1 + limit) p - f_p)

f_p and v_p are force and speed of the predicted trajectory in the middle of the next period, v_d is the
model's velocity, c the velocity gain, and p the present estimate of the contact's peak force. Forces are
scaled by equivalent mass and approach velocity, so that one set of gains serves every mechanism. The approach
velocity is negative for the surface at -clearance; scaled depth and force are positive at both surfaces. In
free flight, before the onset is detected (`onset_detection`), F_c = 0. If a run begins in contact, the
approach velocity is unknown, and F_c is the measured force.

If the force delay is uncertain (`delay_spread` > 0), the compensator estimates the delay when the hardware
leaves the surface. The estimate corrects the speed at which this contact ends. In the following contacts the
estimate also aligns positions with readings, so that D includes the estimate.
"""

from collections.abc import Mapping
from math import inf, pi, sqrt
from typing import ClassVar

from jaxhil.laws.impulse_ledger.alignment.rig import Alignment
from jaxhil.laws.impulse_ledger.contact_model.rig import HINGES, ContactModel, Vector, dot, features, slope
from jaxhil.laws.impulse_ledger.onset_detection.rig import DRIFT, LEVEL, SETTLING, OnsetDetector
from jaxhil.laws.impulse_ledger.reference_trajectory.rig import ReferenceTrajectory
from jaxhil.rig.bounds import DAMPINGS_BY_MASS, FORCES, MASSES, STIFFNESSES_BY_MASS, TIMES
from jaxhil.rig.law_status import IDENTIFIED, NOISY, OUT_OF_CONTACT, SATURATED, TOO_SHORT, UNEXPLAINED, UNSURE
from jaxhil.rig.registry import Compensator, GainSpecification, register
from jaxhil.rig.surfaces import deflection

RELEASE_TIME = 0.03  # time for which the compensator acts after the hardware has left the surface [s]
MIN_MOMENTUM = 1e-9  # momentum below which forces cannot be scaled [kg m/s]
MAX_LAG = 0.2  # upper bound of the lag D [s]
ONSET_PLACE = -0.5  # periods of travel; assumed depth of the hardware at the last reading of free flight
MISFIT = 0.00315  # standard deviation of the contact model's relative error, averaged over `MISFIT_TIME` [1]
MISFIT_TIME = 0.001  # s
MIN_SCALED_SPEED = 1e-9  # speed / approach speed [1]; a lower speed is a rounding error
MIN_CONTACT_DEPTH = 0.001  # lower bound of the depth by which the secant stiffness is divided [s]
MIN_PEAK = 0.3  # minimum of peak force / (mass x approach speed), for a contact at 0.05 Hz [1/s]
MIN_CONTACT_READINGS = 5  # readings in contact; with fewer readings the status is `unsure`
LATE = 0.8  # limit on D divided by the contact's duration [1]; beyond it the status is `too_short`
UNCERTAIN = 0.006  # limit on the reference speed's standard deviation [1]; beyond it the status is `noisy`
MAX_GAIN = 0.01  # limit on the energy gain beyond the contact model, divided by M v^2 [1]
MAX_LOSS = 0.014  # limit on the energy loss beyond the contact model, divided by M v^2 [1]
USUAL_PRELOAD = 1.0  # standard deviation of preload/(mass x approach speed), added to the specified one [1/s]
MAX_DELAY_SPREAD = 0.004  # limit [s]; beyond it a first-order correction is not accurate
MAX_SPREADS = 3.0  # limit on the difference between estimated and specified delay [standard deviations]
ONSET_TICKS = 0.3  # standard deviation of the time of the onset, 1/sqrt(12) [periods]
ONSET_MEAN = 0.25  # mean force at the onset, divided by the force at which the onset is detected [1]
ONSET_SPREAD = 0.4  # standard deviation of the force at the onset, divided by the same force [1]
GAINS = {
    "equivalent_mass": GainSpecification("kg", *MASSES),
    "identification_delay": GainSpecification("s", *TIMES),
    "delay_spread": GainSpecification("s", 0.0, MAX_DELAY_SPREAD),
    "force_noise": GainSpecification("N", *FORCES),
    "force_noise_floor": GainSpecification("1/s", 2e-3, 10.0),
    "prior_stiffness": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
    "prior_stiffness_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
    "prior_slope_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
    "prior_damping_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
    "prior_depth_damping_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
    "prior_unloading_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
    "prior_friction_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
    "prior_preload_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
    "velocity_gain": GainSpecification("1/s", 0.0, 1e5),
    "correction_limit": GainSpecification("1", 0.0, 20.0),
}
# Names of the gains that are the prior standard deviations of the contact model.
SPREADS = tuple(name for name in GAINS if name.startswith("prior_") and name.endswith("_spread"))


@register("impulse_ledger")
class ImpulseLedger(Compensator):
    """Compensator that follows a predicted reference trajectory; see the module's docstring."""

    __slots__ = (
        "_age", "_alignment", "_clearance", "_correction_limit", "_deepest", "_delay", "_delay_spread",
        "_detector", "_estimate", "_floor", "_gain", "_identification_delay", "_lag", "_mass", "_model",
        "_origin", "_outside", "_peak", "_period", "_preload", "_reference", "_side", "_spreads", "_start",
        "_stiffness", "_variance", "_velocity", "status",
    )  # fmt: skip
    _estimate: tuple[float, float]  # mean and variance of the delay after this contact

    gains: ClassVar[Mapping[str, GainSpecification]] = GAINS

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._clearance = clearance
        self._mass = gains["equivalent_mass"]
        self._floor = gains["force_noise_floor"]
        self._gain = gains["velocity_gain"]
        self._correction_limit = gains["correction_limit"]
        self._delay_spread = gains["delay_spread"]
        self._stiffness = gains["prior_stiffness"]
        self._preload = gains["prior_preload_spread"]
        self._spreads = [gains[name] for name in SPREADS]
        self._spreads[-1] = sqrt(self._preload * self._preload + USUAL_PRELOAD * USUAL_PRELOAD)
        self._identification_delay = gains["identification_delay"]
        self._alignment = Alignment(gains["identification_delay"], period)
        self._detector = OnsetDetector(gains["force_noise"])
        self._model = ContactModel()
        self._reference = ReferenceTrajectory()
        self.reset()

    def reset(self) -> None:
        """Restart everything, including the estimated delay."""
        self._delay = 0.0  # estimated minus specified force delay [s]
        self._variance = self._delay_spread * self._delay_spread  # variance of the force delay [s^2]
        self.next_contact()

    def next_contact(self) -> None:
        """Restart everything except the estimated delay."""
        self._age = -1.0  # number of ticks since the first tick of the run
        self._side = 0.0  # 1 or -1 if the run began in contact (with the surface at 0 or -clearance), else 0
        self._velocity = 0.0  # approach velocity [m/s]; 0 if unknown
        self._detector.restart()
        self.status = OUT_OF_CONTACT

    @property
    def force_delay(self) -> float:
        """Return the estimated delay [s] of the force measurement."""
        return self._identification_delay + self._delay

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the force command F_c [N]."""
        self._age += 1.0
        detector, begins = self._detector, self._age == 0.0
        position, velocity = self._alignment.step(position_measured, velocity_desired, begins)
        position -= self._delay * velocity
        reach = deflection(position_desired, self._clearance)
        depth = deflection(position, self._clearance)
        if begins and reach != 0.0:
            self._side = 1.0 if reach > 0.0 else -1.0
        if self._side != 0.0:
            # Return the measured force until model and hardware are out of contact.
            self.status = UNSURE
            inside = self._side * reach > 0.0
            if not (inside or self._side * depth > 0.0):
                self._side = 0.0
            return force_measured if inside else 0.0
        if not detector.total > LEVEL:
            self.status = OUT_OF_CONTACT
            self._approach(force_measured, position_desired, velocity_desired, position, depth)
            if not detector.total > 0.0:
                # Behind the specified surface, the force of a soft contact would be learned as bias.
                if depth == 0.0:
                    detector.learn(force_measured)
                return 0.0
        command = self._follow(force_measured - detector.bias, velocity_desired, position, velocity)
        if not detector.total > LEVEL:
            return 0.0
        if self._reference.released and self._outside * self._period > RELEASE_TIME:
            limit = MAX_SPREADS * self._delay_spread
            shift, self._variance = self._estimate
            self._delay = min(max(self._delay + shift, -limit), limit)
            self._velocity = 0.0
            detector.total = 0.0
            self.status = OUT_OF_CONTACT
            return 0.0
        return command

    def _approach(
        self, force: float, position_desired: float, velocity: float, position: float, depth: float
    ) -> None:
        """Test a force reading for contact; if it shows free flight, prepare for contact on the next tick."""
        side = 1.0 if velocity > 0.0 or self._clearance == inf else -1.0  # direction of the approach
        weight = self._mass * (side * velocity)
        approaches = weight > MIN_MOMENTUM
        # The bias is known only after a reading of free flight during an approach in this direction.
        settled = not self._age * self._period < SETTLING and approaches and self._velocity * velocity > 0.0
        detector = self._detector
        detector.update(force, side, self._floor * weight, settled, side * depth > 0.0)
        if not detector.early > 0.0:
            self._start = position
        if detector.total > 0.0:
            return
        self._velocity = velocity if approaches else 0.0
        if not approaches:
            return
        begun = detector.early > LEVEL
        self._origin = (self._start if begun else position) - ONSET_PLACE * (self._period * velocity)
        self._lag = min(max((position_desired - position) / velocity, 0.0), MAX_LAG)
        self._deepest = 0.0
        self._peak = MIN_PEAK
        self._outside = 0.0  # number of ticks since the hardware left the surface
        self._estimate = 0.0, self._variance
        self._model.restart(self._stiffness, self._spreads, self._variance)
        speed = 1.0 - self._period * detector.missed / weight if begun else 1.0
        self._reference.begin((position - self._origin) / velocity, speed, self._model.theta)

    def _follow(self, force: float, velocity_desired: float, position: float, velocity: float) -> float:
        """Process one reading during a contact; return the force command [N].

        Args:
            force: force reading without bias [N].
            velocity_desired: velocity of the numerical model [m/s].
            position: position of the hardware, delayed like the force [m].
            velocity: velocity of the hardware, delayed like the force [m/s].
        """
        period, model, reference = self._period, self._model, self._reference
        weight = self._mass * self._velocity
        depth = (position - self._origin) / self._velocity
        rate = velocity / self._velocity
        reading = force / weight
        self._deepest = max(self._deepest, depth)
        self._outside = 0.0 if depth > 0.0 else self._outside + 1.0
        phi = features(depth, rate, self._deepest, slope(model.mean, depth) * (1.0 - rate))
        noise = self._detector.variance / (weight * weight)
        self._learn(phi, depth, rate, reading, noise)
        reference.correct(model.theta)
        reference.advance(period, reading, phi)
        push, ahead = reference.bridge(self._lag + 0.5 * period)

        self._peak = max(self._peak, reading)
        peak = self._peak
        if rate > MIN_SCALED_SPEED:
            stiffness = dot(phi[:HINGES], model.mean[:HINGES]) / max(depth, MIN_CONTACT_DEPTH)
            stiffness -= sqrt(max(model.covariance[0][0], 0.0))
            peak = max(peak, sqrt(max(stiffness, 0.0)))
        unlimited = self._gain * (velocity_desired / self._velocity - 0.5 * period * push - ahead)
        limit = self._correction_limit * peak
        correction = min(max(unlimited, -limit), peak + limit - push)
        if self._detector.total > LEVEL:
            self.status = self._evaluate(peak, noise, correction == unlimited)
        return weight * (push + correction)

    def _learn(self, phi: Vector, depth: float, rate: float, reading: float, noise: float) -> None:
        """Update contact model and estimated delay with one `reading` [1/s] and its noise variance `noise`.

        `phi` is the regressor. Reading, `depth` [s] and `rate` [1] are divided by the approach speed.
        """
        model, period, floor = self._model, self._period, self._floor
        model_error = MISFIT * reading
        variance = noise + floor * floor + model_error * model_error * (MISFIT_TIME / period)
        learns = depth > period and (rate > MIN_SCALED_SPEED or dot(phi, model.mean) > 0.0)
        if learns:
            model.learn(phi, reading, variance)
        if not depth > 0.0:
            onset = ONSET_TICKS * period * slope(model.mean, self._deepest) + floor + sqrt(noise)
            spread = sqrt(self._preload * self._preload + (ONSET_SPREAD * onset) ** 2)
            self._estimate = model.estimate_delay(ONSET_MEAN * onset, spread)
        ended = not depth > 0.0 and rate < 0.0
        if learns or ended:
            model.conclude(self._estimate[0] if ended else 0.0)

    def _evaluate(self, peak: float, noise: float, free: bool) -> int:
        """Return the compensator's status during a contact; `free` is true if the correction is not limited.

        `peak` [1/s] is the estimated scaled peak force, and `noise` [1/s^2] the noise variance of a reading.
        """
        reference, model = self._reference, self._model
        if model.count < MIN_CONTACT_READINGS:
            return UNSURE
        if self._lag * peak > LATE * pi:
            return TOO_SHORT
        # Before the detection, an impulse of (DRIFT sigma)^2/(2 k) is below the noise. k, the stiffness
        # divided by the mass, is about peak^2.
        lost_impulse = 0.5 * (DRIFT * DRIFT) * noise / (peak * peak)
        if reference.spread(model.covariance, 0.0) + lost_impulse > UNCERTAIN:
            return NOISY
        if reference.released:
            # If the force has a larger delay or lag than specified, the contact seems to add energy.
            spread = reference.spread(model.covariance, self._estimate[1])
            lost = reference.imbalance()
            if spread > UNCERTAIN or lost < -MAX_GAIN or lost > MAX_LOSS + 3.0 * spread:
                return UNEXPLAINED
        return IDENTIFIED if free else SATURATED
