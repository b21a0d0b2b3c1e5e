"""Watchdog: an energy audit of every contact, from the motion of the numerical model.

A contact begins on the tick on which the model's or the measured position is beyond a specified surface, or
the compensator acts (it may detect a nearer surface). It is audited once none of this has been so for
`settling`, the model moves away and the force has decayed; the audit waits for that at most `MAX_DECAY_WAIT`.
No threshold depends on the noise, because a noisy force that happens to be small may still have impulse to
give. At the latest, the audit takes place in the middle of the gap or when the next contact is announced.
With v_in the model's velocity on the tick before the contact and v now, the audit asks:

- Is the energy consistent? M (v^2 - v_in^2)/2 must be the work -T sum F_c(n) (v(n) + v(n+1))/2 of the
  controller's force, an identity for every integrator with v(n+1) = v(n) - T F_c(n)/M.
- Is the restitution |v|/|v_in| the expected one, within `restitution_margin`?
- Did the compensator identify the contact, by its own status (`law_status`)? Without `equivalent_mass` this
  is the only question. A contact in which no force reading is beyond `fading` counts as not reached.

The expected restitution depends on stiffness k and damping b of this contact: the least-squares fit of the
measured force to the measured position, delayed by `alignment`, and its rate, over the whole contact. An
error delta of the delay changes k only by a factor cos(omega delta), whatever the compensator does; it
changes b by -k delta, which nothing on the rig can distinguish from damping. The polynomial therefore has
terms in z only where they help (`tuning.watchdog.expectation`):

    p = sqrt(reference_stiffness / k) - 1,  w = |v_in| / reference_velocity - 1,  z = b / (2 sqrt(k M)),
    e* = c_1 + c_p p + c_pp p^2 + c_ppp p^3 + c_w w + c_ww w^2 + c_pw p w
         + c_z z + c_zz z^2 + c_pz p z + c_wz w z,   within 0 and 1,

each of p, w, z limited to the range over which the polynomial was fitted.
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

FORCE_DECAY_RATIO = 1e-6  # share of the peak force, or of the approach's momentum: the force has decayed
MAX_DECAY_WAIT = 0.1  # s; longest wait for the force to decay


class Watchdog:
    """Audit of one contact after another.

    Args:
        limits: limits by name, in SI units.
        period: control period [s].
        clearance: clearance of a two-sided contact [m]; infinite for a one-sided one.
        stated: whether the compensator has a status.

    Attributes:
        on: whether there is anything to audit.
        contacts: number of audited contacts.
        record: statuses of the last audited contact.
        restitution: restitution of that contact [1], until `restart`.
        expected: expected restitution of that contact [1], until `restart`.
        balance: energy error of that contact [J], until `restart`.
    """

    __slots__ = (
        "_aligned", "_alignment", "_clearance", "_entry", "_expectation", "_faded", "_fading", "_force",
        "_known", "_longest", "_margin", "_mass", "_measured", "_middle", "_open", "_peak", "_period",
        "_quiet", "_quiet_ticks", "_side", "_stated", "_statuses", "_svf", "_svv", "_sxf", "_sxv", "_sxx",
        "_ticks", "_tolerance", "_unfelt", "_velocity", "_work", "balance", "contacts", "expected", "on",
        "record", "restitution",
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
        self._quiet_ticks = limits["settling"] / period
        self._faded = (limits["settling"] + MAX_DECAY_WAIT) / period
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
        """Forget the current contact and the motion so far, but not `contacts` and `record`."""
        self._known = False
        self._open = False
        self._entry = 0.0
        self._side = 1.0
        self._quiet = 0
        self._ticks = 0
        self._velocity = 0.0
        self._force = 0.0
        self._aligned = 0.0
        self._peak = 0.0
        self._unfelt = 0.0
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
        """Return the faults that this tick shows, 0 if none.

        Args:
            previous_force: force F_c of the tick before [N].
            status: the compensator's status of that force.
            force: force reading of this tick [N].
            position: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            measured: position reading of this tick [m].
        """
        if self._known:
            before = self._velocity
        else:
            self._known = True
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
                self._quiet = 0
            else:
                self._quiet += 1
            self._ticks += 1
            self._statuses.take(status)
            self._measured = self._measured or abs(force) > self._fading
            self._work += self._period * previous_force * 0.5 * (before + velocity)
            size = abs(previous_force)
            if size > self._peak:
                self._peak = size
            self._regress(force, aligned)
            faded = (
                size <= FORCE_DECAY_RATIO * self._peak or size <= self._unfelt or self._quiet >= self._faded
            )
            outside = not in_contact and self._quiet >= self._quiet_ticks
            leaving = outside and self._side * velocity < 0.0 and faded
            if leaving or side != self._side:
                fault = self._audit(velocity)
            elif self._ticks > self._longest:
                fault = CONTACT_TOO_LONG
        self._velocity = velocity
        self._force = force
        self._aligned = aligned
        return fault

    def conclude(self, previous_force: float, status: int) -> int:
        """Audit the current contact, if there is one, and return the faults.

        Args:
            previous_force: force F_c of the last tick [N].
            status: the compensator's status of that force.
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
        """Return the last audit in words."""
        text = f"contact {self.contacts}: restitution {self.restitution:.4g}, expected {self.expected:.4g}"
        return f"{text}, law {STATUS_NAMES[self.record.status].replace('_', ' ')}" if self._stated else text

    def _begin(self, entry: float, side: float) -> None:
        self._open = True
        self._entry = entry
        self._unfelt = FORCE_DECAY_RATIO * self._mass * abs(entry) / MAX_DECAY_WAIT
        self._side = side
        self._quiet = 0
        self._ticks = 0
        self._peak = 0.0
        self._work = 0.0
        self._measured = False
        self._statuses.restart()
        self._sxx = self._sxv = self._svv = self._sxf = self._svf = 0.0

    def _regress(self, force: float, aligned: float) -> None:
        """Add the interval between two ticks to the regression if both its ends are in contact."""
        # A condition on the force would select the larger of noisy readings and bias the stiffness.
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
        doubt = 0
        if self._stated:
            self.record = self._statuses.count(self.contacts, self._measured)
            doubt = LAW_IN_DOUBT if self.record.status != IDENTIFIED else 0
        return doubt | (self._energies(velocity, self._mass) if self._mass > 0.0 else 0)

    def _energies(self, velocity: float, mass: Positive) -> int:
        entry = self._entry
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
    """Expected restitution of a contact, a polynomial of its stiffness, damping and approach speed."""

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
        """Return the polynomial of the module's docstring; a stiffness <= 0 counts as the softest.

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
    # NaN is not above the lower end, so that it gives the lower end.
    if not value > span[0]:
        return span[0]
    return value if value < span[1] else span[1]
