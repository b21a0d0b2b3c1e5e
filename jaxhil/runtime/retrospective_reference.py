"""The retrospective reference: identify the contact, work out what should have happened, and pay it back.

Scaled by approach speed v0 and equivalent mass M, F the force-depth map identified on delay-aligned readings
(X, V, y), (x_r, v_r) the motion that the contact should have had since its entry:

    f_0 = max(F(x_d, v_d), 0)
    f_e = clip(gate [w^2 (x_d - x_r) + 2 z w (v_d - T f_0/2 - v_r)], -limit, limit)
    in contact:  F_c = f_0 + (y - F(X, V)) + f_e
    separated:   F_c = f_e  until the hardware has left the surface for 6 ms, then 0

No model of the motion simulator is used.
"""

from collections.abc import Mapping
from math import floor
from typing import ClassVar

from .filters import DelayLine
from .force_depth_map import ForceDepthMap
from .reference_motion import ReferenceMotion
from .registry import GainSpecification, register
from .surfaces import deflection

FAREWELL = 0.006  # s for which it goes on after the hardware has left the surface
LONGEST_LAG = 0.1  # s for which it waits for hardware that has not touched yet
SURE = 0.5  # of the prior's variance that has to be learnt
OUT_OF_CONTACT, IDENTIFIED, UNSURE, SATURATED = 0, 1, 2, 3


@register("retrospective_reference")
class RetrospectiveReference:
    """Force-depth map, reference and repayment.

    Every contact starts afresh, also with the other surface. A run that begins in contact has no approach
    speed to scale by: there F_c is the measured force. `status` is what stands behind the last command:
    `OUT_OF_CONTACT`, `IDENTIFIED`, `UNSURE` (less than half is learnt: it goes by the measured force and what
    the prior says of the contact), or `SATURATED` (the correction is at its limit).
    """

    __slots__ = (
        "_clearance",
        "_count",
        "_first",
        "_floor",
        "_fraction",
        "_frequency",
        "_gone",
        "_impulse",
        "_last",
        "_limit",
        "_line",
        "_map",
        "_mass",
        "_middle",
        "_moved",
        "_offset",
        "_period",
        "_ratio",
        "_reference",
        "_sample",
        "_sample_depth",
        "_sample_speed",
        "_share",
        "_side",
        "_speed",
        "_squares",
        "_started",
        "_ticks",
        "_touched",
        "status",
    )

    gains: ClassVar[Mapping[str, GainSpecification]] = {
        "equivalent_mass": GainSpecification("kg", lowest=0.0, exclusive=True),
        "identification_delay": GainSpecification("s", lowest=0.0),
        "prior_stiffness": GainSpecification("1/s^2", lowest=0.0),
        "prior_stiffness_spread": GainSpecification("1", lowest=0.0),
        "prior_slope_spread": GainSpecification("1", lowest=0.0),
        "prior_damping": GainSpecification("1/s", lowest=0.0),
        "prior_damping_spread": GainSpecification("1/s", lowest=0.0),
        "force_noise_floor": GainSpecification("1/s", lowest=0.0, exclusive=True),
        "reference_frequency": GainSpecification("rad/s", lowest=0.0),
        "reference_damping_ratio": GainSpecification("1", lowest=0.0),
        "correction_limit": GainSpecification("1/s", lowest=0.0),
        "force_replay": GainSpecification("1", lowest=0.0),
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
        self._map = ForceDepthMap(
            gains["prior_stiffness"],
            gains["prior_stiffness_spread"],
            gains["prior_slope_spread"],
            gains["prior_damping"],
            gains["prior_damping_spread"],
        )
        self._reference = ReferenceMotion(gains["force_replay"], period)
        self._floor = gains["force_noise_floor"]
        self._frequency = gains["reference_frequency"]
        self._ratio = gains["reference_damping_ratio"]
        self._limit = gains["correction_limit"]
        self._middle = 0.0
        self._last = 0.0
        self.reset()

    @property
    def identified(self) -> tuple[float, float]:
        """(0, 0): what it identifies is more than a stiffness, and forgotten with the contact."""
        return 0.0, 0.0

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
    ) -> float:
        """The force F_c [N]."""
        period = self._period
        clearance = self._clearance
        _, position, velocity = self._align(position_measured, velocity_desired)
        bent = deflection(position, clearance)
        touching = deflection(position_desired, clearance)
        now = 1.0 if touching > 0.0 else (-1.0 if touching < 0.0 else 0.0)
        enters = now != 0.0 and now != self._side
        if enters:
            approach = now * velocity_desired
            sound = self._mass * approach > 0.0 and abs(touching) <= 2.0 * period * approach
            self._side = now
            self._speed = approach if sound else 0.0
            self._touched = False
            self._gone = 0.0
        side = self._side
        if side == 0.0:
            self._take_noise(force_measured, bent)
            self.status = OUT_OF_CONTACT
            return 0.0
        speed = self._speed
        scale = speed if speed > 0.0 else 1.0
        weight = self._mass * scale
        x = (-clearance - position_desired if side < 0.0 else position_desired) / scale
        v = side * velocity_desired / scale
        depth = (-clearance - position if side < 0.0 else position) / scale
        rate = side * velocity / scale
        force = 0.0 if bent * side < 0.0 else side * force_measured / weight
        touched_before = self._touched
        if not touched_before and not (speed > 0.0 and depth > 0.0):
            self._take_noise(force_measured, bent)
        if not enters:
            self._gone += 1.0
        if depth > 0.0:
            self._gone = 0.0
        if speed > 0.0:
            command, separated = self._follow(enters, x, v, depth, rate, force, weight)
        else:
            separated = x <= 0.0
            command = 0.0 if separated else force
            self.status = UNSURE
        patience = FAREWELL if self._touched or not speed > 0.0 else LONGEST_LAG
        if separated and self._gone * period > patience * (1.0 + 1e-9):
            self._side = 0.0
            self.status = OUT_OF_CONTACT
            return 0.0
        return side * weight * command

    def _follow(
        self, enters: bool, x: float, v: float, depth: float, rate: float, force: float, weight: float
    ) -> tuple[float, bool]:
        """The command over M v0 [1/s], and whether the numerical model has separated."""
        period = self._period
        contact = self._map
        reference = self._reference
        if enters:
            contact.restart()
            self._first = x
            reference.restart(x)
            self._sample = force
            self._sample_depth = depth - period * rate
            self._sample_speed = rate
        if depth > 0.0:
            if not self._touched:
                self._touch(depth, rate)
            scale = (self._count if self._count > 0.0 else 1.0) * (weight * weight)
            mean = self._squares / scale if scale > 0.0 else 0.0
            contact.update(depth, rate, force, self._floor * self._floor + mean)
        reference.tick(contact)

        own = contact.force(x, v)
        separated = x <= 0.0 or (v < 0.0 and own <= 0.0)
        if not own > 0.0:
            own = 0.0
        frequency = self._frequency
        limit = self._limit
        gate = contact.learnt(x, v)
        correction = gate * (
            frequency * frequency * (x - reference.depth)
            + 2.0 * self._ratio * frequency * (v - 0.5 * period * own - reference.speed)
        )
        self.status = IDENTIFIED if gate >= SURE else UNSURE
        if correction > limit:
            correction = limit
            self.status = SATURATED
        elif correction < -limit:
            correction = -limit
            self.status = SATURATED
        command = correction
        if not separated:
            command = own + (force - contact.force(depth, rate)) + correction
        if self._touched:
            self._remember(force, depth, rate)
        self._sample = force
        self._sample_depth = depth
        self._sample_speed = rate
        return command, separated

    def _touch(self, depth: float, rate: float) -> None:
        """The hardware's entry: where its samples fall on the reference's grid."""
        period = self._period
        since = 0.5 * period
        if rate > 0.0:
            since = depth / rate
            if not since <= period:
                since = period
        shift = (self._first - since) / period
        whole = floor(shift)
        self._fraction = shift - whole
        self._offset = -1 - whole
        self._ticks = 0
        self._touched = True

    def _remember(self, force: float, depth: float, rate: float) -> None:
        """This tick's sample, moved to the reference's grid, into its history."""
        fraction = self._fraction
        before = self._sample
        moved = before + fraction * (force - before)
        index = self._ticks + self._offset
        self._ticks += 1
        if index == 0:
            self._impulse = 0.5 * moved * self._first / self._period
        elif index > 0:
            self._impulse += 0.5 * (self._moved + moved)
        self._moved = moved
        if index >= 0:
            before_depth = self._sample_depth
            before_rate = self._sample_speed
            self._reference.remember(
                index,
                self._impulse,
                before_depth + fraction * (depth - before_depth),
                before_rate + fraction * (rate - before_rate),
            )

    def _align(self, position: float, velocity: float) -> tuple[float, float, float]:
        """The measured position [m] a tick less than the delay ago; position and velocity [m/s] as old as
        the force."""
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
            self._started = True
        aligned = newest + self._share * (self._middle - newest)
        rate = (newest - self._last) / (2.0 * period)
        self._last = self._middle
        self._middle = newest
        return newest, aligned, rate

    def _take_noise(self, force: float, bent: float) -> None:
        """A reading out of contact, if it is one: it tells how noisy the force is."""
        if bent == 0.0:
            self._squares += force * force
            self._count += 1.0

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """The numerical model's position [m] itself."""
        return position

    def reset(self) -> None:
        """Forget everything."""
        self._side = 0.0
        self._speed = 0.0
        self._touched = False
        self._gone = 0.0
        self._squares = 0.0
        self._count = 0.0
        self._first = 0.0
        self._fraction = 0.0
        self._offset = 0
        self._ticks = 0
        self._impulse = 0.0
        self._moved = 0.0
        self._sample = 0.0
        self._sample_depth = 0.0
        self._sample_speed = 0.0
        self._started = False
        self.status = OUT_OF_CONTACT

    def next_contact(self) -> None:
        """Forget everything: every contact starts afresh."""
        self.reset()
