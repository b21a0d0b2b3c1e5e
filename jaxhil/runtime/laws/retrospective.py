"""What the retrospective laws share: to work out what should have happened, and to make up for it.

A rig reads the contact force late, and its drives follow late: the numerical model gains or loses energy that
contact in space would not give it. These laws find the surface and identify the contact while it lasts, as a
map from depth to force; they integrate the motion that it should have had since its entry, the reference; and
they add to the force a correction that brings the model's speed back to the reference's.

Scaled by approach speed v0 and equivalent mass M, F the force-depth map identified on delay-aligned readings
(X, V, y), p the peak force that it predicts, v_r the reference's speed, t the time left of 2/p
since the hardware's entry:

    f_0 = clip(F(x_d, v_d), 0, MOST p), separated 0
    f_e = clip((v_d - T f_0/2 - v_r)/(1/c + s t), -limit p, (1 + limit) p - f_0)
    no contact:  F_c = 0, until the force tells of one, and of where its surface is
    in contact:  F_c = f_0 + (y - F(X, V)) + f_e
    separated:   F_c = f_e  until the hardware has left the surface for 6 ms, then 0

Slow contact is followed on a slower scale of time: with T and 1/c times its pace, v0 over it, all that is
said of usual contact holds of it. notebooks/guide/retrospective_reference.md says more.
"""

from collections.abc import Mapping
from math import inf, sqrt
from typing import ClassVar

from ..bounds import DAMPINGS_BY_MASS, FORCES, MASSES, STIFFNESSES_BY_MASS, TIMES
from ..law_status import IDENTIFIED, OUT_OF_CONTACT, SATURATED, UNSURE
from ..registry import Compensator, GainSpecification
from ..surfaces import deflection
from .balance import Balance
from .contact_plane import ContactPlane, Meeting, found_variance
from .doubts import FAR, Doubts
from .force_depth_map import SURFACE, Prior
from .history import History
from .onset import Found, Onset, rarity
from .readings import Alignment, ForceNoise
from .reintegration import ReferenceMotion, Scales

FAREWELL = 0.006  # s for which it goes on after the hardware has left the surface
USUAL_PACE = 14.0  # 1/s: slower contact is followed on a slower scale of time
SLOWEST = 0.01  # of that
MOST = 1.2  # of the peak force, that the model is to feel of the map
MISFIT_TIME = 0.001  # s, over which a force may be off by the law's `misfit`
MARGIN = 0.0625  # of the stretch between two samples, that the surface is off its end
LEAST_WEIGHT = 1e-9  # kg m/s, mass times approach speed: at less nothing is scaled by it
READINGS = 2  # per tick that the map learns from, while it has to catch up
PRIOR = (  # the gains that `Prior` is made of, in its order
    "prior_stiffness",
    "prior_stiffness_spread",
    "prior_slope_spread",
    "prior_damping_spread",
    "prior_depth_damping_spread",
    "prior_unloading_spread",
    "prior_friction_spread",
    "prior_preload_spread",
)


class Retrospective(Compensator):
    """Reference and repayment; what identifies the contact is the law's own.

    `_shift` [s] is by how much the force is older than by the given delay, `_deeper` [s] by how much the
    surface is deeper than it was met, on the contact's scale of time. Every contact starts afresh, but
    for what is known of where the surfaces are. A run that begins in contact has no approach speed to scale
    by: there F_c is the measured force. `status` is what stands behind the last command: `OUT_OF_CONTACT`;
    `UNSURE`: nothing is identified yet, or there is nothing to scale by, and it goes by the measured force
    and what the prior says of the contact; `SATURATED`: identified, and the correction is at its limit; else
    what `doubts` says.
    """

    __slots__ = (
        "_alignment", "_balance", "_bias_spread", "_clearance", "_curve", "_dead_zone", "_deeper", "_deepest",
        "_doubts", "_floor", "_gone", "_hardware_deepest", "_history", "_learnt_deepest", "_limit", "_mass",
        "_next", "_noise", "_onset", "_pace", "_period", "_plane_spread", "_planes", "_reference", "_replay",
        "_scales", "_share", "_shift", "_side", "_speed", "_started", "_strength", "_velocity_gain", "status",
    )  # fmt: skip

    misfit: ClassVar[float] = 0.003  # of a force, by which a map may be wrong
    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "equivalent_mass": GainSpecification("kg", *MASSES),
        "identification_delay": GainSpecification("s", *TIMES),
        "force_noise": GainSpecification("N", *FORCES),
        "dead_zone": GainSpecification("N", *FORCES),
        "bias_spread": GainSpecification("N", *FORCES),
        "plane_spread": GainSpecification("m", 1e-6, 0.1),
        "prior_stiffness": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "prior_stiffness_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "prior_slope_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "prior_damping_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
        "prior_depth_damping_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
        "prior_unloading_spread": GainSpecification("1/s^2", *STIFFNESSES_BY_MASS),
        "prior_friction_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
        "prior_preload_spread": GainSpecification("1/s", *DAMPINGS_BY_MASS),
        "force_noise_floor": GainSpecification("1/s", 1e-4, 10.0),
        "velocity_gain": GainSpecification("1/s", 0.0, 1e5),
        "repayment_time": GainSpecification("1", 0.0, 10.0),
        "correction_limit": GainSpecification("1", 0.0, 20.0),
        "force_replay": GainSpecification("1", 0.0, 1.0),
        "replay_noise": GainSpecification("1/s", 0.01, 100.0),
    }

    def __init__(self, gains: Mapping[str, float], period: float, clearance: float) -> None:
        self._period = period
        self._clearance = clearance
        self._mass = gains["equivalent_mass"]
        self._alignment = Alignment(gains["identification_delay"], period)
        self._noise = ForceNoise(gains["force_noise"])
        self._history = History()
        self._onset = Onset(period)
        self._scales = Scales(clearance)
        self._reference = ReferenceMotion(self._history, self._scales, period)
        self._dead_zone = gains["dead_zone"]
        self._bias_spread = gains["bias_spread"]
        self._plane_spread = gains["plane_spread"]
        self._floor = gains["force_noise_floor"]
        self._velocity_gain = gains["velocity_gain"]
        self._share = gains["repayment_time"]
        self._limit = gains["correction_limit"]
        self._replay = gains["force_replay"]
        self._strength = gains["replay_noise"] * gains["replay_noise"]
        self._doubts = Doubts()
        self._balance = Balance()
        self._shift = 0.0
        self._deeper = 0.0
        self._prepare(gains, Prior(*(gains[name] for name in PRIOR)))
        self.reset()

    @property
    def contact_plane(self) -> float:
        """By how much [m] the surface met last is deeper than told; 0 before the first."""
        return self._scales.plane + self._deeper * self._scales.length

    def step(self, force_measured, position_desired, velocity_desired, position_measured) -> float:
        """The force F_c [N]."""
        zone = self._dead_zone
        begins = not self._started
        position, velocity = self._alignment.step(position_measured, velocity_desired, begins)
        if begins:
            stride = self._period * velocity_desired
            self._doubts.start(position_measured - stride, stride)
            self._started = True
        self._doubts.move(position_measured)
        # A run's first reading counts as none: the sensor's delay line may not have been filled.
        shown = not (begins or (zone > 0.0 and force_measured == 0.0))
        force = force_measured + (zone if force_measured > 0.0 else (-zone if force_measured < 0.0 else 0.0))
        self._history.take(force, shown, position, velocity)
        self._noise.take(force, shown, self._side == 0.0)
        if begins:
            reach = deflection(position_desired, self._clearance)
            self._side = 1.0 if reach > 0.0 else (-1.0 if reach < 0.0 else 0.0)
        if self._side == 0.0 and not self._meets(force, shown, position_desired, velocity_desired):
            return 0.0
        self._gone += 1.0
        if self._speed > 0.0:
            command, separated = self._follow(
                force, shown, position_desired, velocity_desired, position, velocity
            )
        else:
            command, separated = self._pass_on(force, position_desired, position)
        if separated and self._gone * self._period > FAREWELL * (1.0 + 1e-9):
            self._side = 0.0
            self._speed = 0.0
            self.status = OUT_OF_CONTACT
            self._onset.restart()
            return 0.0
        return command

    def next_contact(self) -> None:
        """A fresh run: all but where the surfaces are is forgotten."""
        self._side = 0.0
        self._speed = 0.0
        self._gone = 0.0
        self._deepest = 0.0
        self._hardware_deepest = 0.0
        self._learnt_deepest = 0.0
        self._next = 0
        self._pace = 1.0
        self._noise.restart()
        self._history.restart()
        self._onset.restart()
        self._doubts.restart()
        self._balance.restart()
        self._started = False
        self.status = OUT_OF_CONTACT

    def reset(self) -> None:
        """Forget everything."""
        self._planes = {side: ContactPlane(self._plane_spread) for side in (1.0, -1.0)}
        self._scales.plane = 0.0
        self.next_contact()

    def _meets(self, force: float, shown: bool, position_desired: float, velocity_desired: float) -> bool:
        """Flying freely: whether the force tells that a surface was met; if so, the contact begins."""
        self.status = OUT_OF_CONTACT
        side = 1.0 if velocity_desired > 0.0 else -1.0
        speed = side * velocity_desired
        if not self._mass * speed > LEAST_WEIGHT or (side < 0.0 and self._clearance == inf):
            self._onset.restart()
            return False
        found = self._watch(side, speed, force, shown)
        if found is None:
            return False
        self._meet(side, speed, position_desired, found)
        return True

    def _watch(self, side: float, speed: float, force: float, shown: bool) -> Found | None:
        """Flying to the surface on this side: what the force tells of it, if it was met."""
        scales = self._scales
        scales.side = side
        weight = self._mass * speed
        noise = self._floor * self._floor + self._noise.variance / (weight * weight)
        spread = self._bias_spread / weight
        onset = self._onset
        history = self._history
        plane = self._planes[side]
        width = self._period * speed
        onset.take(side * force / weight, shown)

        def rare(age: int) -> float:
            away = scales.beyond(history.recall(history.newest - age).position) - plane.place
            return rarity(away, plane.spread, width)

        return onset.find(noise, spread * spread, rare)

    def _meet(self, side: float, speed: float, position: float, found: Found) -> None:
        """A surface is found, met between two samples: between them it lies where it was most expected."""
        history = self._history
        scales = self._scales
        entry = history.newest - found.age
        start = history.recall(entry)
        pace = sqrt(found.stiffness if found.stiffness > 0.0 else 0.0) / USUAL_PACE
        pace = (pace if pace > SLOWEST else SLOWEST) if pace < 1.0 else 1.0
        self._pace = pace
        self._reference.period = self._period * pace
        scales.side = side
        scales.speed = speed
        scales.length = speed / pace
        scales.bias = side * found.bias * (self._mass * speed)
        scales.weight = self._mass * speed * pace
        low = scales.beyond(start.position)
        high = scales.beyond(history.recall(entry + 1).position)
        plane = self._planes[side]
        width = high - low
        plane.learn(low, high, found_variance(width, found.age))
        # Not at the end of the stretch: the reference would not have entered.
        end = high - MARGIN * width
        scales.plane = low if plane.place < low else (end if plane.place > end else plane.place)
        since = (high - scales.plane) / width if high > low else 0.5
        stiffness = found.stiffness / (pace * pace)
        met = 0.5 * (low + high) - found.earlier * width
        around = width * width * (1.0 / 12.0 + found.variance)
        meeting = Meeting(scales.plane, met, around, speed, pace, self._reference.period, stiffness)
        earlier = self._begin(meeting)
        depth = scales.depth(position) - self._deeper
        self._side = side
        self._speed = speed
        self._gone = 0.0
        self._deepest = self._hardware_deepest = self._learnt_deepest = 0.0
        self._next = entry + 1 - min(earlier, entry)
        self._doubts.restart()
        self._balance.restart()
        self._doubts.late = depth - float(found.age) * self._reference.period
        self._doubts.displaced = abs(self.contact_plane) > FAR * self._plane_spread
        self._reference.begin(entry, start, since, depth if depth > 0.0 else 0.0)

    def _follow(
        self,
        force: float,
        shown: bool,
        position_desired: float,
        velocity_desired: float,
        position: float,
        velocity: float,
    ) -> tuple[float, bool]:
        """The command [N], and whether the numerical model has separated."""
        curve = self._curve
        scales = self._scales
        reference = self._reference
        x = scales.depth(position_desired) - self._deeper
        v = scales.rate(velocity_desired)
        rate = scales.rate(velocity)
        depth = scales.depth(position) - (self._shift * rate + self._deeper)
        if -SURFACE <= depth <= SURFACE:
            depth = 0.0
        if depth > 0.0:
            self._gone = 0.0
        if x > self._deepest:
            self._deepest = x
        if depth > self._hardware_deepest:
            self._hardware_deepest = depth

        zone = self._dead_zone / scales.weight
        noise = self._noise.variance / (scales.weight * scales.weight)
        reference.shift = self._shift
        reference.deeper = self._deeper
        self._catch_up(self._floor * self._floor + noise, zone)
        expected = curve.force(depth, rate, self._hardware_deepest)
        read = scales.force(force)
        if not shown:
            read = zone if expected > zone else (expected if expected > 0.0 else 0.0)
        whole = self._strength + noise
        reference.replay = self._replay * self._strength / whole if whole > 0.0 else 0.0
        reference.tick(curve)

        own = curve.force(x, v, self._deepest)
        separated = x <= 0.0 or (v < 0.0 and own <= 0.0)
        if not own > 0.0:
            own = 0.0
        peak = curve.peak_force()
        felt = MOST * peak
        if own > felt:
            own = felt
        self._doubts.unexplained = self._balance.unexplained(
            curve, peak, self._learnt_deepest, reference.shift, self._pace
        ) or self._open(peak)
        middle = v - 0.5 * reference.period * own
        correction = self._repayment(peak, 0.0 if separated else own, middle, zone)
        command = correction if separated else own + (read - expected) + correction
        return self._side * scales.weight * command, separated

    def _catch_up(self, variance: float, zone: float) -> None:
        """Learn from the readings since the surface was met, one after the other; noise of a `variance`
        [1/s^2], the dead zone [1/s]."""
        reference = self._reference
        for _ in range(READINGS):
            if self._next > self._history.newest:
                break
            depth, rate, force, noise, shown = self._reading(self._next, variance)
            if depth > self._learnt_deepest:
                self._learnt_deepest = depth
            if depth > 0.0 and shown:
                self._doubts.readings += 1
            one = rate, self._learnt_deepest, force, noise
            if shown:
                moved = reference.shift * rate + reference.deeper
                self._balance.take(self._curve, depth, moved, *one, self._variance())
            self._learn(depth, *one, not shown, zone)
            self._next += 1

    def _reading(self, tick: int, variance: float) -> tuple[float, float, float, float, bool]:
        """What was read at a tick of this contact: depth [s] and speed as old as the force by the given
        delay, force [1/s], its variance [1/s^2] with noise of a `variance`, whether the sensor showed it."""
        sample = self._history.recall(tick)
        read, shown = self._history.reading(tick)
        scales = self._scales
        force = scales.force(read)
        off = self.misfit * force
        misfit = off * off * (MISFIT_TIME / self._reference.period)
        return scales.depth(sample.position), scales.rate(sample.velocity), force, variance + misfit, shown

    def _pass_on(self, force: float, position_desired: float, position: float) -> tuple[float, bool]:
        """The force as it is read [N], in a run that begins in contact, and whether the model has
        separated."""
        side = self._side
        bent = side * deflection(position, self._clearance)
        separated = not side * deflection(position_desired, self._clearance) > 0.0
        if bent > 0.0:
            self._gone = 0.0
        self.status = UNSURE
        return 0.0 if separated or bent < 0.0 else force, separated

    def _repayment(self, peak: float, own: float, speed: float, zone: float) -> float:
        """f_e [1/s], by the map's peak, f_0 and the model's speed half a period on; `status` judges it."""
        reference = self._reference
        least = -(self._limit * peak)
        most = (1.0 + self._limit) * peak - own
        # Elastic contact of this peak lasts no less.
        left = 2.0 / peak - float(self._history.newest - reference.entry) * reference.period
        gain = self._velocity_gain / self._pace
        slower = 1.0 + gain * (self._share * (left if left > 0.0 else 0.0))
        correction = gain * (speed - reference.live.speed) / slower
        self.status = self._doubts.status(peak, self._variance(), zone, self._speed)
        if correction > most or correction < least:
            correction = most if correction > most else least
            if self.status == IDENTIFIED:
                self.status = SATURATED
        return correction

    def _prepare(self, gains: Mapping[str, float], prior: Prior) -> None:
        """What identifies the contact, and the curve that it makes of it, `_curve`."""
        raise NotImplementedError

    def _begin(self, meeting: Meeting) -> int:
        """A contact begins. From how many ticks before the meeting on to learn from the readings."""
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

    def _open(self, peak: float) -> bool:
        """Whether what is not known of the delay matters in a contact of this peak force [1/s]."""
        return False
