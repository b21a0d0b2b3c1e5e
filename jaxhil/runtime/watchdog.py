"""The watchdog: an energy audit of every contact, from the motion of the numerical model.

A contact begins on the tick on which the model's or the measured position is beyond a surface; it is audited
once both have been outside for `settling` and the model moves away, or when the next contact is announced.
The audit's questions, with v_in the model's velocity on the tick before the contact and v its velocity now:

- Is the energy balanced? M (v^2 - v_in^2)/2 must be the work -T sum F_c(n) (v(n) + v(n+1))/2 of the force
  that the controller gave, an identity for every integrator with v(n+1) = v(n) - T F_c(n)/M.
- Is the restitution |v|/|v_in| what it should be, within `restitution_margin`?
"""

from collections.abc import Mapping

from .faults import CONTACT_TOO_LONG, ENERGY_BALANCE, RESTITUTION


class Watchdog:
    """One contact after another, audited.

    Attributes: `on`, whether there is anything to watch; `contacts`, those audited since `restart`;
    `restitution` and `expected`, of the last contact audited.
    """

    __slots__ = (
        "_before",
        "_clearance",
        "_contact",
        "_entry",
        "_expected",
        "_force",
        "_inverse_energy",
        "_known",
        "_longest",
        "_margin",
        "_mass",
        "_outside",
        "_period",
        "_settling",
        "_ticks",
        "_tolerance",
        "_velocity",
        "_work",
        "contacts",
        "expected",
        "on",
        "restitution",
    )

    def __init__(self, limits: Mapping[str, float], period: float, clearance: float) -> None:
        self.on = limits["equivalent_mass"] > 0.0
        self._clearance = clearance
        self._period = period
        self._mass = limits["equivalent_mass"]
        self._settling = limits["settling"] / period
        self._longest = limits["longest_contact"] / period
        self._margin = limits["restitution_margin"]
        self._expected = limits["expected_restitution"]
        self._tolerance = limits["energy_tolerance"]
        self.restart()

    def restart(self) -> None:
        """Forget the contact under way and all before it."""
        self._known = False
        self._contact = False
        self._before = 0.0
        self._entry = 0.0
        self._outside = 0
        self._ticks = 0
        self._velocity = 0.0
        self._work = 0.0
        self.contacts = 0
        self.expected = 0.0
        self.restitution = 0.0

    def tick(self, force: float, position: float, velocity: float, measured: float) -> int:
        """The fault that this tick shows, 0 if none.

        `force` [N] is what the controller gave on the tick before; position [m] and velocity [m/s] are the
        numerical model's, measured [m] the motion simulator's.
        """
        before = self._velocity if self._known else velocity
        self._known = True
        self._velocity = velocity
        touching = position > 0.0 or measured > 0.0
        touching = touching or position < -self._clearance or measured < -self._clearance
        if not self._contact:
            if not touching:
                return 0
            self._contact = True
            self._entry = before
            self._ticks = 0
            self._work = 0.0
        self._ticks += 1
        self._work -= self._period * force * 0.5 * (before + velocity)
        if touching:
            self._outside = 0
            return CONTACT_TOO_LONG if self._ticks > self._longest else 0
        self._outside += 1
        # Away from the surface that is nearer: after a contact at x = 0 the velocity is negative.
        if self._outside > self._settling:
            return self.conclude(force)
        return 0

    def conclude(self, force: float) -> int:
        """Audit the contact under way, if there is one; the fault that it shows."""
        if not self._contact:
            return 0
        self._contact = False
        self.contacts += 1
        entry, velocity = self._entry, self._velocity
        energy = 0.5 * self._mass * entry * entry
        balance = 0.5 * self._mass * velocity * velocity - energy - self._work
        if not abs(balance) <= self._tolerance * energy:
            return ENERGY_BALANCE
        self.restitution = abs(velocity) / abs(entry) if entry != 0.0 else 0.0
        self.expected = self._expected
        if not abs(self.restitution - self.expected) <= self._margin:
            return RESTITUTION
        return 0

    def detail(self) -> str:
        """The last audit in words."""
        return f"contact {self.contacts}: restitution {self.restitution:.4g}, expected {self.expected:.4g}"
