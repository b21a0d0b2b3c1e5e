"""Impulse ledger: a reference trajectory at the time of the readings, bridged to the present.

A force reading tells what the numerical model should have felt D ago, D being the lag of hardware and force
behind the model, measured in free flight at the onset. The law fits a contact model to the readings
(`contact_model`), advances a reference trajectory at the time of the readings (`reference_trajectory`),
bridges the D seconds to now with the fitted model, and steers the numerical model's velocity onto the result:

    F_c = f_p + clip(c (v_d - T f_p/2 - v_p), -limit p, (1 + limit) p - f_p)

f_p and v_p are force and speed of the bridged trajectory at the middle of the coming period, v_d is the
model's velocity and p the peak force of contact as far as it is known. Forces are scaled by equivalent mass
and approach speed, so that one set of gains serves every mechanism. In free flight, until the onset is
detected (`onset_detection`), F_c = 0. A run that begins in contact has no approach speed to scale by: there
F_c is the measured force.
"""

from collections.abc import Mapping
from math import inf, pi, sqrt
from typing import ClassVar

from ..bounds import DAMPINGS_BY_MASS, FORCES, MASSES, STIFFNESSES_BY_MASS, TIMES
from ..law_status import IDENTIFIED, NOISY, OUT_OF_CONTACT, SATURATED, TOO_SHORT, UNEXPLAINED, UNSURE
from ..registry import Compensator, GainSpecification, register
from ..surfaces import deflection
from .contact_model import HINGES, ContactModel, dot, features
from .onset_detection import LEVEL, SETTLING, OnsetDetector
from .readings import Alignment
from .reference_trajectory import ReferenceTrajectory

RELEASE_TIME = 0.006  # s for which the law acts after the hardware has left the surface
LEAST_MOMENTUM = 1e-9  # kg m/s; below it forces cannot be scaled
LONGEST_LAG = 0.2  # s; the lag D is at most that
ONSET_PLACE = -0.5  # periods from the surface to the last free reading
MISFIT = 0.003  # of a force, by which the contact model errs for `MISFIT_TIME`
MISFIT_TIME = 0.001  # s
OUTLYING = 16.0  # variances; a reading beyond that tells of contact
HOLD_TIME = 0.004  # s; time constant of the misfit that the bridge holds
SLOWEST = 1e-9  # speed; a slower one is at rest, but for rounding
SHALLOW = 0.001  # s; depth below which a secant stiffness is not taken
LEAST_STIFFNESS = 1.0  # 1/s^2; stiffness of the softest contact
HIGHEST = 1.5  # peak forces that the bridged force is at most
FEW_READINGS = 5  # in contact, below which the model is unsure
LATE = 0.5  # share of the contact that is over at the onset, beyond which little time is left
UNCERTAIN = 0.006  # standard deviation of the reference's speed, above which restitution is uncertain
IMBALANCE = 0.014  # energy that the model may leave unexplained [1]
SPREADS = (
    "prior_stiffness_spread",
    "prior_slope_spread",
    "prior_damping_spread",
    "prior_depth_damping_spread",
    "prior_unloading_spread",
    "prior_friction_spread",
    "prior_preload_spread",
)  # gains: the prior standard deviations of the contact model


@register("impulse_ledger")
class ImpulseLedger(Compensator):
    """Compensator with contact model, reference trajectory and bridge; see the module's text."""

    __slots__ = (
        "_alignment", "_clearance", "_correction_limit", "_deepest", "_detector", "_floor", "_gain",
        "_in_contact", "_lag", "_mass", "_misfit", "_model", "_origin", "_outside", "_peak", "_period",
        "_readings", "_reference", "_side", "_since_start", "_speed", "status",
    )  # fmt: skip

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "equivalent_mass": GainSpecification("kg", *MASSES),
        "identification_delay": GainSpecification("s", *TIMES),
        "force_noise": GainSpecification("N", *FORCES),
        "force_noise_floor": GainSpecification("1/s", 1e-3, 10.0),
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

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._clearance = clearance
        self._mass = gains["equivalent_mass"]
        self._floor = gains["force_noise_floor"]
        self._gain = gains["velocity_gain"]
        self._correction_limit = gains["correction_limit"]
        self._alignment = Alignment(gains["identification_delay"], period)
        self._detector = OnsetDetector(gains["force_noise"])
        self._model = ContactModel(gains["prior_stiffness"], [gains[name] for name in SPREADS])
        self._reference = ReferenceTrajectory()
        self.reset()

    def reset(self) -> None:
        """Restart everything."""
        self._since_start = 0.0  # ticks of this run
        self._side = 1.0  # direction in which the surface is approached
        self._speed = 0.0  # approach speed [m/s]; 0: nothing can be scaled
        self._origin = 0.0  # position of the surface, along the side [m]
        self._lag = 0.0  # D [s]
        self._deepest = 0.0  # of the hardware [s]
        self._misfit = 0.0  # low-passed y - f(X, V) [1/s]
        self._peak = 0.0  # largest reading so far [1/s]
        self._outside = 0.0  # ticks since the hardware left the surface
        self._readings = 0  # in contact
        self._in_contact = False
        self._detector.restart()
        self.status = OUT_OF_CONTACT

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """Return the force command F_c [N]."""
        begins = self._since_start == 0.0
        position, velocity = self._alignment.step(position_measured, velocity_desired, begins)
        settled = not self._since_start * self._period < SETTLING
        self._since_start += 1.0
        if begins:
            reach = deflection(position_desired, self._clearance)
            self._in_contact = reach != 0.0
            self._side = 1.0 if reach > 0.0 else -1.0
            self._speed = 0.0
        if self._in_contact and not self._speed > 0.0:
            return self._pass_on(force_measured, position_desired, position)
        detector = self._detector
        if not self._in_contact:
            self.status = OUT_OF_CONTACT
            self._approach(force_measured, position_desired, velocity_desired, position, settled)
            if not detector.total > 0.0:
                detector.learn(force_measured)
                return 0.0
            self._in_contact = detector.total > LEVEL
        command = self._follow(force_measured - detector.bias, velocity_desired, position, velocity)
        return command if self._in_contact else 0.0

    def _approach(
        self, force: float, position_desired: float, velocity_desired: float, position: float, settled: bool
    ) -> None:
        """Watch a reading of free flight; where it shows no contact, contact begins anew after it."""
        side = 1.0 if velocity_desired > 0.0 or self._clearance == inf else -1.0
        speed = side * velocity_desired
        approaches = self._mass * speed > LEAST_MOMENTUM
        detector = self._detector
        # What comes after a reading of free flight, at a speed and towards a side that it is known for.
        settled = settled and approaches and self._speed > 0.0 and side == self._side
        detector.watch(force, side, self._floor * (self._mass * speed), settled)
        if detector.total > 0.0:
            return
        self._side = side
        self._speed = speed if approaches else 0.0
        if not approaches:
            return
        self._origin = side * position - ONSET_PLACE * (self._period * speed)
        lag = side * (position_desired - position) / speed
        self._lag = 0.0 if lag < 0.0 else (LONGEST_LAG if lag > LONGEST_LAG else lag)
        self._deepest = 0.0
        self._misfit = 0.0
        self._peak = 0.0
        self._outside = 0.0
        self._readings = 0
        self._model.restart()
        self._reference.begin((side * position - self._origin) / speed, self._model.theta)

    def _follow(self, force: float, velocity_desired: float, position: float, velocity: float) -> float:
        """Return the command [N] after one reading of force [N], position [m] and velocity [m/s]."""
        period, side, speed = self._period, self._side, self._speed
        model, reference = self._model, self._reference
        weight = self._mass * speed
        depth = (side * position - self._origin) / speed
        rate = side * velocity / speed
        reading = side * force / weight
        self._deepest = depth if depth > self._deepest else self._deepest
        phi = features(depth, rate, self._deepest)
        off = MISFIT * reading
        variance = self._detector.variance / (weight * weight) + self._floor * self._floor
        variance += off * off * (MISFIT_TIME / period)
        tells = rate > SLOWEST or dot(phi, model.mean) > 0.0 or reading * reading > OUTLYING * variance
        if tells and depth > period:
            model.learn(phi, reading, variance)
            model.conclude()
            self._readings += 1
        reference.correct(model.theta)
        reference.advance(period, reading, phi)
        missed = reading - dot(model.theta, phi)
        self._misfit += period / (period + HOLD_TIME) * (missed - self._misfit)
        push, ahead = reference.bridge(self._lag + 0.5 * period, self._misfit)
        command = self._command(push, ahead, depth, rate, reading, phi, side * velocity_desired / speed)
        self._outside = 0.0 if depth > 0.0 else self._outside + 1.0
        if self._in_contact and reference.released and self._outside * period > RELEASE_TIME:
            self._end()
        return side * weight * command

    def _command(
        self,
        push: float,
        ahead: float,
        depth: float,
        rate: float,
        reading: float,
        phi: list[float],
        desired: float,
    ) -> float:
        """Return the scaled command [1/s], by the bridged force [1/s] and speed and the model's speed."""
        mean = self._model.mean
        secant = dot(phi[:HINGES], mean[:HINGES]) / (depth if depth > SHALLOW else SHALLOW)
        variance = self._model.covariance[0][0]
        known = secant if secant > LEAST_STIFFNESS else LEAST_STIFFNESS
        known -= sqrt(variance) if variance > 0.0 else 0.0
        likely = sqrt(known if known > LEAST_STIFFNESS else LEAST_STIFFNESS)
        self._peak = max(self._peak, reading, 1.0)
        peak = likely if rate > SLOWEST and likely > self._peak else self._peak
        push = push if push < HIGHEST * peak else HIGHEST * peak
        wanted = self._gain * (desired - 0.5 * self._period * push - ahead)
        least = -self._correction_limit * peak
        most = (1.0 + self._correction_limit) * peak - push
        correction = most if wanted > most else (least if wanted < least else wanted)
        if self._in_contact:
            self.status = self._judge(peak, correction == wanted)
        return push + correction

    def _judge(self, peak: float, free: bool) -> int:
        """Return the status of a command whose correction is `free` of its limits, for a peak force [1/s]."""
        reference = self._reference
        if self._readings < FEW_READINGS:
            return UNSURE
        if self._lag * peak > LATE * pi:
            return TOO_SHORT
        spread = reference.spread(self._model.covariance)
        if spread > UNCERTAIN:
            return NOISY
        if reference.released and abs(reference.imbalance()) > IMBALANCE + 3.0 * spread:
            return UNEXPLAINED
        return IDENTIFIED if free else SATURATED

    def _pass_on(self, force: float, position_desired: float, position: float) -> float:
        """Return the measured force [N] of a run that began in contact, until both have left the surface."""
        side = self._side
        inside = side * deflection(position_desired, self._clearance) > 0.0
        bent = side * deflection(position, self._clearance)
        self._outside = 0.0 if bent > 0.0 else self._outside + 1.0
        self.status = UNSURE
        if not inside and self._outside * self._period > RELEASE_TIME:
            self._end()
            return 0.0
        return force if inside and not bent < 0.0 else 0.0

    def _end(self) -> None:
        """End the contact."""
        self._in_contact = False
        self._detector.total = 0.0
        self.status = OUT_OF_CONTACT
