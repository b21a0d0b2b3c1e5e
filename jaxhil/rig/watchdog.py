"""Watchdog: energy audit of every contact, from the motion of the numerical model.

A contact begins on the first tick on which the model's or the measured position is beyond a specified
surface. It also begins if the compensator acts, which may detect a nearer surface. The watchdog audits the
contact as soon as none of these conditions has been true for the time `settling`. In addition, the model must
move away and the force must have decayed. The watchdog waits for the decay for at most `MAX_DECAY_WAIT`. No
threshold depends on the noise, because a noisy force can be small by chance before its whole impulse has
acted. The audit takes place at the latest in the middle between two surfaces, or at the call of
`next_contact`. With v_in and v, the model's velocities on the tick before the contact and on the present
tick, the audit checks three conditions:

- Energy: M (v^2 - v_in^2)/2 equals the work -T sum F_c(n) (v(n) + v(n+1))/2 of the controller's force. This
  is an identity for every integrator with v(n+1) = v(n) - T F_c(n)/M.
- Restitution: |v|/|v_in| differs from the expected restitution by at most `restitution_margin`.
- Status: the compensator reports that it identified the contact (`law_status`). Without `equivalent_mass`
  the audit checks only this condition. A contact without a force reading above `fading` has the status
  `not_reached`.

The expected restitution depends on stiffness k and damping b of this contact. k and b come from a
least-squares fit, during the whole contact, of the measured force to the measured position (delayed by
`alignment`) and its rate. If the delay is wrong by delta, k changes only by a factor cos(omega delta) with
any compensator. But b changes by -k delta, which on the rig is indistinguishable from damping. The polynomial
therefore has terms in z only if they improve the fit (`tuning.watchdog.expectation`):

    p = sqrt(reference_stiffness / k) - 1,  w = |v_in| / reference_velocity - 1,  z = b / (2 sqrt(k M)),
    e* = c_1 + c_p p + c_pp p^2 + c_ppp p^3 + c_w w + c_ww w^2 + c_pw p w
         + c_z z + c_zz z^2 + c_pz p z + c_wz w z,

where p, w and z are clamped to the ranges for which the polynomial was fitted. e* is clamped to the range
from 0 to 1.
"""

from math import inf, sqrt

from jaxhil.rig.faults import CONTACT_TOO_LONG, ENERGY_BALANCE, LAW_IN_DOUBT, RESTITUTION
from jaxhil.rig.filters import DelayLine
from jaxhil.rig.law_status import (
    IDENTIFIED,
    OUT_OF_CONTACT,
    STATUS_NAMES,
    UNSTATED,
    ContactCount,
    StatusCount,
)
from jaxhil.rig.surfaces import deflection
from jaxhil.rig.types import Limits, Positive

MAX_DECAY_WAIT = 0.1  # longest wait for the force to decay [s]
# share of its peak, or of momentum/MAX_DECAY_WAIT, below which a force has decayed [1]
FORCE_DECAY_RATIO = 1e-6


class Watchdog:
    """Audit of successive contacts: energy, restitution and compensator status.

    Args:
        limits: limits by name, in SI units.
        period: control period [s].
        clearance: clearance of a two-sided contact [m]; infinite for a one-sided contact.
        stated: whether the compensator reports a status.

    Attributes:
        on: whether the watchdog audits the energy or the compensator's status.
        contacts: number of audited contacts.
        record: compensator status of the last audited contact.
        restitution: restitution of the last audited contact [1]; 0 after `restart`.
        expected: expected restitution of the last audited contact [1]; 0 after `restart`.
        balance: energy error of the last audited contact [J]; 0 after `restart`.
    """

    __slots__ = (
        "_aligned", "_alignment", "_clearance", "_entry_velocity", "_expectation", "_fading", "_force",
        "_free_ticks", "_has_motion", "_longest", "_margin", "_mass", "_max_settling_ticks", "_measured",
        "_middle", "_negligible_force", "_open", "_peak", "_period", "_settling_ticks", "_side", "_stated",
        "_statuses", "_svf", "_svv", "_sxf", "_sxv", "_sxx", "_ticks", "_tolerance", "_velocity", "_work",
        "balance", "contacts", "expected", "on", "record", "restitution",
    )  # fmt: skip
    _period: Positive

    def __init__(self, limits: Limits, period: Positive, clearance: float, stated: bool = False) -> None:
        self.on = stated or limits["equivalent_mass"] > 0.0
        self._stated = stated
        self._statuses = StatusCount()
        self._clearance = clearance
        self._middle = -0.5 * clearance
        self._period = period
        self._mass = limits["equivalent_mass"]
        self._settling_ticks = limits["settling"] / period
        self._max_settling_ticks = (limits["settling"] + MAX_DECAY_WAIT) / period
        self._longest = limits["longest_contact"] / period if self._mass > 0.0 else inf
        self._fading = limits["fading"]
        self._margin = limits["restitution_margin"]
        self._tolerance = limits["energy_balance"]
        self._alignment = DelayLine(limits["alignment"], period)
        self._expectation = Expectation(limits)
        self.restart()
        self.contacts = 0
        self.record = ContactCount(0, 0, 0, 0, 0, 0, OUT_OF_CONTACT, UNSTATED)

    def restart(self) -> None:
        """Forget the current contact and the past motion, but keep `contacts` and `record`."""
        self._has_motion = False
        self._open = False
        self._entry_velocity = 0.0
        self._side = 1.0
        self._free_ticks = 0
        self._ticks = 0
        self._velocity = 0.0
        self._force = 0.0
        self._aligned = 0.0
        self._peak = 0.0
        self._negligible_force = 0.0
        self._work = 0.0
        self._measured = False
        self._statuses.restart()
        self._sxx = self._sxv = self._svv = self._sxf = self._svf = 0.0
        self.balance = 0.0
        self.expected = 0.0
        self.restitution = 0.0

    def tick(
        self,
        previous_force: float,
        status: int,
        force: float,
        position: float,
        velocity: float,
        measured: float,
    ) -> int:
        """Process one tick and audit a contact that has ended; return the fault bits, 0 if none.

        Args:
            previous_force: force F_c on the previous tick [N].
            status: the compensator's status on the previous tick.
            force: force reading of this tick [N].
            position: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            measured: position reading of this tick [m].
        """
        if self._has_motion:
            before = self._velocity
        else:
            self._has_motion = True
            self._alignment.start(measured, velocity)
            before, previous_force = velocity, 0.0
        clearance = self._clearance
        aligned = deflection(self._alignment.step(measured), clearance)
        in_contact = (
            deflection(position, clearance) != 0.0
            or deflection(measured, clearance) != 0.0
            or status not in (UNSTATED, OUT_OF_CONTACT)
        )
        side = 1.0 if position > self._middle else -1.0
        fault = 0
        if not self._open and in_contact:
            self._begin(before, side)
        if self._open:
            if in_contact:
                self._free_ticks = 0
            else:
                self._free_ticks += 1
            self._ticks += 1
            self._statuses.take(status)
            self._measured = self._measured or abs(force) > self._fading
            self._work += self._period * previous_force * 0.5 * (before + velocity)
            magnitude = abs(previous_force)
            if magnitude > self._peak:
                self._peak = magnitude
            self._regress(force, aligned)
            has_decayed = (
                magnitude <= FORCE_DECAY_RATIO * self._peak
                or magnitude <= self._negligible_force
                or self._free_ticks >= self._max_settling_ticks
            )
            has_settled = not in_contact and self._free_ticks >= self._settling_ticks
            is_leaving = has_settled and self._side * velocity < 0.0 and has_decayed
            if is_leaving or side != self._side:
                fault = self._audit(velocity)
            elif self._ticks > self._longest:
                fault = CONTACT_TOO_LONG
        self._velocity = velocity
        self._force = force
        self._aligned = aligned
        return fault

    def conclude(self, previous_force: float, status: int) -> int:
        """End and audit the current contact, if there is one; return the fault bits.

        Args:
            previous_force: force F_c on the last tick [N].
            status: the compensator's status on the last tick.
        """
        if not self._open:
            return 0
        self._statuses.take(status)
        before = self._velocity
        if not self._mass > 0.0:
            return self._audit(before)
        velocity = before - self._period * previous_force / self._mass
        self._work += self._period * previous_force * 0.5 * (before + velocity)
        return self._audit(velocity)

    def detail(self) -> str:
        """Describe the last audit: contact number, restitution, expected restitution, compensator status."""
        text = f"contact {self.contacts}: restitution {self.restitution:.4g}, expected {self.expected:.4g}"
        return f"{text}, law {STATUS_NAMES[self.record.status].replace('_', ' ')}" if self._stated else text

    def _begin(self, entry: float, side: float) -> None:
        self._open = True
        self._entry_velocity = entry
        self._negligible_force = FORCE_DECAY_RATIO * self._mass * abs(entry) / MAX_DECAY_WAIT
        self._side = side
        self._free_ticks = 0
        self._ticks = 0
        self._peak = 0.0
        self._work = 0.0
        self._measured = False
        self._statuses.restart()
        self._sxx = self._sxv = self._svv = self._sxf = self._svf = 0.0

    def _regress(self, force: float, aligned: float) -> None:
        """Update the sums for the fit of stiffness and damping if this tick and the last are in contact."""
        # A threshold on noisy forces would prefer large readings and bias the stiffness.
        side = self._side
        before = self._aligned
        if aligned * side > 0.0 and before * side > 0.0:
            middle = side * (aligned + before) * 0.5
            rate = side * (aligned - before) / self._period
            mean = side * (force + self._force) * 0.5
            self._sxx += middle * middle
            self._sxv += middle * rate
            self._svv += rate * rate
            self._sxf += middle * mean
            self._svf += rate * mean

    def _audit(self, velocity: float) -> int:
        self._open = False
        self.contacts += 1
        law_fault = 0
        if self._stated:
            self.record = self._statuses.count(self.contacts, self._measured)
            law_fault = LAW_IN_DOUBT if self.record.status != IDENTIFIED else 0
        return law_fault | (self._energies(velocity, self._mass) if self._mass > 0.0 else 0)

    def _energies(self, velocity: float, mass: Positive) -> int:
        entry = self._entry_velocity
        energy = 0.5 * mass * entry * entry
        self.balance = 0.5 * mass * velocity * velocity - energy + self._work
        if not abs(self.balance) <= self._tolerance * energy:
            return ENERGY_BALANCE
        speed = abs(entry)
        if speed == 0.0:
            return 0
        determinant = self._sxx * self._svv - self._sxv * self._sxv
        stiffness = damping = 0.0
        if determinant > 0.0:
            stiffness = (self._sxf * self._svv - self._svf * self._sxv) / determinant
            damping = (self._svf * self._sxx - self._sxf * self._sxv) / determinant
        self.restitution = abs(velocity) / speed
        self.expected = self._expectation.restitution(stiffness, damping, speed, mass)
        if not abs(self.restitution - self.expected) <= self._margin:
            return RESTITUTION
        return 0


class Expectation:
    """Polynomial for the expected restitution from a contact's stiffness, damping and approach speed."""

    __slots__ = (
        "_coefficients", "_loss", "_reference_stiffness", "_reference_velocity", "_softness", "_speed",
    )  # fmt: skip
    _reference_stiffness: Positive
    _reference_velocity: Positive

    def __init__(self, limits: Limits) -> None:
        self._reference_stiffness = limits["reference_stiffness"]
        self._reference_velocity = limits["reference_velocity"]
        self._softness = limits["softness_lowest"], limits["softness_highest"]
        self._speed = limits["speed_lowest"], limits["speed_highest"]
        self._loss = limits["loss_lowest"], limits["loss_highest"]
        self._coefficients = [
            limits[f"expected_{term}"]
            for term in ("1", "p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
        ]

    def restitution(self, stiffness: float, damping: float, speed: float, mass: Positive) -> float:
        """Return the expected restitution [1] from the polynomial in p, w and z (see the module's docstring).

        For a stiffness <= 0, use the largest p and the smallest z.

        Args:
            stiffness: identified stiffness [N/m].
            damping: identified damping [N s/m].
            speed: approach speed [m/s].
            mass: equivalent mass [kg].
        """
        p, z = self._softness[1], self._loss[0]
        if stiffness > 0.0:
            root = sqrt(stiffness * mass)
            if root > 0.0:
                p = _within(sqrt(self._reference_stiffness / stiffness) - 1.0, self._softness)
                z = _within(damping / (2.0 * root), self._loss)
        w = _within(speed / self._reference_velocity - 1.0, self._speed)
        c_1, c_p, c_pp, c_ppp, c_w, c_ww, c_pw, c_z, c_zz, c_pz, c_wz = self._coefficients
        expected = c_1 + p * (c_p + p * (c_pp + p * c_ppp)) + w * (c_w + w * c_ww + p * c_pw)
        return _within(expected + z * (c_z + z * c_zz + p * c_pz + w * c_wz), (0.0, 1.0))


def _within(value: float, span: tuple[float, float]) -> float:
    # The comparison with NaN is false, so that NaN gives the lower bound.
    if not value > span[0]:
        return span[0]
    return value if value < span[1] else span[1]
