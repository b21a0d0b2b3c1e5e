"""What the retrospective laws share: to work out what should have happened, and to make up for it.

A rig reads the contact force late, and its drives follow late: the numerical model gains or loses energy that
contact in space would not give it. These laws identify the contact while it lasts, as a map from depth to
force; they integrate the motion that it should have had since its entry, the reference; and they add to the
force a correction that brings the model's speed back to the reference's.

Scaled by approach speed v0 and equivalent mass M, F the force-depth map identified on delay-aligned readings
(X, V, y), p the peak force that it predicts, v_r the reference's speed:

    f_0 = max(F(x_d, v_d), 0)
    f_e = clip(c (v_d - T f_0/2 - v_r), -limit p, limit p)
    in contact:  F_c = f_0 + (y - F(X, V)) + f_e
    separated:   F_c = f_e  until the hardware has left the surface for 6 ms, then 0

How noise, a dead zone and a surface that is nearer than expected are met:
notebooks/guide/retrospective_reference.md.
"""

from collections.abc import Mapping
from typing import ClassVar

from ..bounds import DAMPINGS_BY_MASS, FORCES, MASSES, STIFFNESSES_BY_MASS, TIMES
from ..filters import DelayLine
from ..law_status import IDENTIFIED, OUT_OF_CONTACT, SATURATED, UNSURE
from ..registry import Compensator, GainSpecification
from ..surfaces import deflection
from .doubts import EARLY, Doubts
from .force_depth_map import SURFACE, Curve, Prior
from .hardware_samples import HardwareSamples
from .reintegration import ReferenceMotion

SEEN = 8  # readings out of contact that show how noisy the force is
OUTSTANDING = 16.0  # times the noise's variance: what hardly is noise
FAREWELL = 0.006  # s for which it goes on after the hardware has left the surface
LONGEST_LAG = 0.1  # s for which it waits for hardware that is not in contact yet
PRIOR = (  # the gains that `Prior` is made of, in its order
    "prior_stiffness",
    "prior_stiffness_spread",
    "prior_slope_spread",
    "prior_damping_spread",
    "prior_depth_damping_spread",
    "prior_unloading_spread",
)


class Retrospective(Compensator):
    """Reference and repayment; what identifies the contact is the law's own.

    `_shift` [s] is by how much the force is older than by the given delay. Every contact starts afresh, also
    with the other surface. A run that begins in contact has no approach speed to scale by: there F_c is the
    measured force. `status` is what stands behind the last command: `OUT_OF_CONTACT`; `UNSURE`: nothing is
    identified yet, or there is nothing to scale by, and it goes by the measured force and what the prior says
    of the contact; `SATURATED`: identified, and the correction is at its limit; else what `doubts` says.
    """

    __slots__ = (
        "_clearance", "_count", "_curve", "_dead_zone", "_deepest", "_doubts", "_elapsed", "_entered",
        "_floor", "_force_noise", "_gone", "_hardware_deepest", "_last", "_limit", "_line", "_mass",
        "_middle", "_period", "_plane", "_reference", "_replay", "_samples", "_share", "_shift", "_side",
        "_speed", "_squares", "_started", "_strength", "_surface", "_velocity_gain", "status",
    )  # fmt: skip

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "equivalent_mass": GainSpecification("kg", *MASSES),
        "identification_delay": GainSpecification("s", *TIMES),
        "force_noise": GainSpecification("N", *FORCES),
        "dead_zone": GainSpecification("N", *FORCES),
        "prior_stiffness": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "prior_stiffness_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "prior_slope_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "prior_damping_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
        "prior_depth_damping_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
        "prior_unloading_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "force_noise_floor": GainSpecification("1/s", 1e-4, 10.0),
        "velocity_gain": GainSpecification("1/s", 0.0, 1e5),
        "correction_limit": GainSpecification("1", 0.0, 20.0),
        "force_replay": GainSpecification("1", 0.0, 1.0),
        "replay_noise": GainSpecification("1/s", 0.01, 100.0),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        delay = gains["identification_delay"]
        self._period = period
        self._clearance = clearance
        self._mass = gains["equivalent_mass"]
        # The line delays by a tick less, so that the speed can be a difference about the middle.
        whole = delay > period
        self._line = DelayLine(delay - period, period) if whole else None
        self._share = 1.0 if whole else delay / period
        self._reference = ReferenceMotion(period)
        self._samples = HardwareSamples(self._reference, period)
        self._force_noise = gains["force_noise"]
        self._dead_zone = gains["dead_zone"]
        self._floor = gains["force_noise_floor"]
        self._velocity_gain = gains["velocity_gain"]
        self._limit = gains["correction_limit"]
        self._replay = gains["force_replay"]
        self._strength = gains["replay_noise"] * gains["replay_noise"]
        self._middle = 0.0
        self._last = 0.0
        self._doubts = Doubts()
        self._shift = 0.0
        self._prepare(gains, Prior(*(gains[name] for name in PRIOR)))
        self.reset()

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """The force F_c [N]."""
        period = self._period
        clearance = self._clearance
        position, velocity = self._align(position_measured, velocity_desired)
        bent = deflection(position, clearance)
        reach = deflection(position_desired, clearance)
        now = 1.0 if reach > 0.0 else (-1.0 if reach < 0.0 else 0.0)
        enters = now != 0.0 and now != self._side
        if enters:
            self._meet(now, reach, velocity_desired)
        side = self._side
        if side == 0.0:
            if bent == 0.0:
                self._take_noise(force_measured)
            self.status = OUT_OF_CONTACT
            return 0.0
        speed = self._speed
        scale = speed if speed > 0.0 else 1.0
        weight = self._mass * scale
        x = (-clearance - position_desired if side < 0.0 else position_desired) / scale
        v = side * velocity_desired / scale
        given = (-clearance - position if side < 0.0 else position) / scale + self._plane
        rate = side * velocity / scale
        depth = given - self._shift * rate
        if -SURFACE <= depth <= SURFACE:
            depth = 0.0
        zone = self._dead_zone
        hidden = False
        force = 0.0
        if not bent * side < 0.0:
            hidden = zone > 0.0 and force_measured == 0.0
            if force_measured > 0.0:
                force = side * (force_measured + zone) / weight
            elif force_measured < 0.0:
                force = side * (force_measured - zone) / weight
        if not self._entered and not (speed > 0.0 and depth > 0.0) and bent == 0.0:
            self._sort_out(force_measured, given, weight)
        if not enters:
            self._gone += 1.0
        if depth > 0.0:
            self._gone = 0.0
        if speed > 0.0:
            command, separated = self._follow(enters, x, v, given, depth, rate, force, hidden, weight)
        else:
            separated = x <= 0.0
            command = 0.0 if separated else force
            self.status = UNSURE
        patience = FAREWELL if self._entered or not speed > 0.0 else LONGEST_LAG
        if separated and self._gone * period > patience * (1.0 + 1e-9):
            self._side = 0.0
            self.status = OUT_OF_CONTACT
            return 0.0
        return side * weight * command

    def _meet(self, side: float, depth: float, velocity: float) -> None:
        """The numerical model is beyond another surface: a contact begins."""
        approach = side * velocity
        sound = self._mass * approach > 0.0 and abs(depth) <= 2.0 * self._period * approach
        self._side = side
        self._speed = approach if sound else 0.0
        self._entered = False
        self._gone = 0.0
        self._plane = 0.0
        self._doubts.restart()

    def _follow(
        self,
        enters: bool,
        x: float,
        v: float,
        given: float,
        depth: float,
        rate: float,
        force: float,
        hidden: bool,
        weight: float,
    ) -> tuple[float, bool]:
        """The command over M v0 [1/s], and whether the numerical model has separated."""
        period = self._period
        curve = self._curve
        reference = self._reference
        samples = self._samples
        self._elapsed += 1
        if enters:
            self._begin()
            reference.restart(x)
            samples.begin(x, force, not hidden, given - period * rate, rate)
            self._elapsed = 0
            self._deepest = 0.0
            self._hardware_deepest = 0.0
        if x > self._deepest:
            self._deepest = x
        if depth > self._hardware_deepest:
            self._hardware_deepest = depth
        deepest = self._hardware_deepest

        zone = self._dead_zone / weight
        square = weight * weight
        noise = self._noise() / square if square > 0.0 else 0.0
        variance = self._floor * self._floor + noise
        if depth > 0.0:
            if not self._entered:
                self._entered = True
                samples.enter(depth, rate)
                self._doubts.late = samples.first + self._elapsed * period
            if not hidden:
                self._doubts.read(depth, deepest, force, variance)
        reference.shift = self._shift
        self._learn(given, rate, deepest, force, variance, hidden, zone)
        expected = curve.force(depth, rate, deepest)
        if hidden:
            force = zone if expected > zone else (expected if expected > 0.0 else 0.0)
        whole = self._strength + noise
        reference.replay = self._replay * self._strength / whole if whole > 0.0 else 0.0
        reference.tick(curve)

        own = curve.force(x, v, self._deepest)
        separated = x <= 0.0 or (v < 0.0 and own <= 0.0)
        if not own > 0.0:
            own = 0.0
        correction = self._repayment(curve, v - 0.5 * period * own, deepest, zone)
        samples.take(self._entered, force, not hidden, given, rate, deepest)
        return (correction if separated else own + (force - expected) + correction), separated

    def _repayment(self, curve: Curve, speed: float, deepest: float, zone: float) -> float:
        """f_e [1/s], for the speed of the model in the middle of the next period; `status` judges it."""
        peak = curve.peak_force()
        limit = self._limit * peak
        correction = self._velocity_gain * (speed - self._reference.live.speed)
        self.status = self._doubts.status(curve, peak, deepest, self._variance(), zone, self._speed)
        if correction > limit or correction < -limit:
            correction = limit if correction > limit else -limit
            if self.status == IDENTIFIED:
                self.status = SATURATED
        return correction

    def _prepare(self, gains: Mapping[str, float], prior: Prior) -> None:
        """What identifies the contact, and the curve that it makes of it, `_curve`."""
        raise NotImplementedError

    def _begin(self) -> None:
        """A contact begins."""
        raise NotImplementedError

    def _learn(
        self,
        depth: float,
        rate: float,
        deepest: float,
        force: float,
        variance: float,
        hidden: bool,
        zone: float,
    ) -> None:
        """One reading more: depth [s] and speed, as old as the force by the given delay, the deepest point
        [s], force [1/s], its variance [1/s^2], whether the dead zone hides it, that zone [1/s]."""
        raise NotImplementedError

    def _variance(self) -> float:
        """Of the force that is expected where it was read last [1/s^2]."""
        raise NotImplementedError

    def _noise(self) -> float:
        """The force's variance [N^2]: the known one, or what readings out of contact show if that is more."""
        known = self._force_noise * self._force_noise
        seen = self._squares / (self._count if self._count > 0.0 else 1.0)
        return seen if seen > known else known

    def _align(self, position: float, velocity: float) -> tuple[float, float]:
        """The measured position [m] and velocity [m/s] as old as the force."""
        period = self._period
        line = self._line
        newest = position
        if line is not None:
            if not self._started:
                line.start(position, velocity)
            newest = line.step(position)
        if not self._started:
            stride = period * velocity
            self._middle = newest - stride
            self._last = newest - 2.0 * stride
            self._doubts.start(position - stride, stride)
            self._started = True
        self._doubts.move(position)
        aligned = newest + self._share * (self._middle - newest)
        rate = (newest - self._last) / (2.0 * period)
        self._last = self._middle
        self._middle = newest
        return aligned, rate

    def _sort_out(self, force: float, depth: float, weight: float) -> None:
        """A reading [N] out of contact while one is under way: noise, or the hardware, met too early."""
        least = self._floor * weight
        usual = self._noise() + least * least
        if not (self._count >= SEEN and force * force > OUTSTANDING * usual):
            self._take_noise(force)
            return
        doubts = self._doubts
        doubts.early += 1
        if doubts.early == 1:
            self._surface = -depth
        if doubts.early > EARLY:
            self._plane = self._surface

    def _take_noise(self, force: float) -> None:
        """A reading out of contact: it tells how noisy the force is."""
        self._squares += force * force
        self._count += 1.0

    def reset(self) -> None:
        """Forget everything."""
        self._side = 0.0
        self._speed = 0.0
        self._entered = False
        self._gone = 0.0
        self._squares = 0.0
        self._count = 0.0
        self._samples.reset()
        self._deepest = 0.0
        self._hardware_deepest = 0.0
        self._elapsed = 0
        self._plane = 0.0
        self._surface = 0.0
        self._doubts.restart()
        self._started = False
        self.status = OUT_OF_CONTACT
