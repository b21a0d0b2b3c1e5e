"""Six-axis watchdog: an audit of every contact, from the motion of the numerical model.

A contact begins on the first tick on which the compensator acts. For a compensator without a status, it
begins on the first tick on which the measured force exceeds `fading`. If the compensator then knows the
hardware's lag behind the model, the lag must be between `lag_lowest` and `lag_highest`. The contact is
audited as soon as the condition of its beginning has been false for the time `settling`, at the latest at the
call of `next_contact`. V_in is the twist on the tick before the contact, V the present twist, M the relative
mass matrix, W_c the controller's wrench about the chaser's origin, and |W|^2 = W . M^-1 W. The audit checks
four conditions:

- Momentum: |M (V - V_in) - T sum W_c| is at most `momentum_error` times the sum of |T sum W_c| and 0.05
  |M V_in|. Otherwise the model integrates a different wrench, or has a different mass.
- Passivity: T sum W_c . V is at most `energy_gain` times the kinetic energy before contact, V_in . M V_in/2.
- Impulse: the impulse error that the compensator has not corrected after the contact is at most
  `unpaid_impulse` times the contact's impulse.
- Status: the compensator reports that it identified the contact (`law_status`).
"""

from math import sqrt

from jaxhil.rig.faults import CONTACT_TOO_LONG, LAW_IN_DOUBT
from jaxhil.rig.law_status import IDENTIFIED, OUT_OF_CONTACT, UNSTATED, ContactCount, StatusCount
from jaxhil.rig.six_axes.faults import ENERGY_GAIN, LAG, MOMENTUM, UNPAID_IMPULSE
from jaxhil.rig.six_axes.registry import ModelConstants
from jaxhil.rig.six_axes.vectors import (
    AXES,
    Matrix,
    Vector,
    add_multiple,
    dot,
    length,
    product,
    subtract,
    wrench_at_chaser,
)
from jaxhil.rig.types import Count, Limits, Positive

# Fraction of the approach momentum that is added to the impulse, because a grazing touch has a small impulse.
MOMENTUM_SHARE = 0.05


class SixAxisWatchdog:
    """Audit of successive contacts: momentum, passivity, impulse and compensator status.

    Attributes:
        on: whether contacts are audited.
        contacts: number of audited contacts.
        record: compensator status of the last audited contact.
        momentum_error: momentum error of that contact, divided by its impulse [1].
        energy_gain: energy that the contact released, divided by the approach energy [1].
        unpaid_impulse: uncorrected impulse error, divided by the contact's impulse [1].
    """

    __slots__ = (
        "_energy_limit", "_entry", "_fading", "_has_motion", "_impulse", "_inverse", "_lag_highest",
        "_lag_lowest", "_longest", "_mass", "_measured", "_momentum_limit", "_open", "_period", "_pose",
        "_quiet", "_quiet_ticks", "_stated", "_statuses", "_ticks", "_twist", "_unpaid_limit", "_work",
        "contacts", "energy_gain", "momentum_error", "on", "record", "unpaid_impulse",
    )  # fmt: skip
    _entry: Vector
    _impulse: Vector
    _inverse: Matrix
    _mass: Matrix
    _period: Positive
    _pose: Vector
    _twist: Vector
    contacts: Count

    def __init__(
        self, limits: Limits, constants: ModelConstants, period: Positive, stated: bool = False
    ) -> None:
        self._stated = stated
        self._statuses = StatusCount()
        self._mass = constants.mass_matrix
        self._inverse = constants.inverse_mass
        self._period = period
        self._fading = limits["fading"]
        self._quiet_ticks = limits["settling"] / period
        self._longest = limits["longest_contact"] / period
        self._momentum_limit = limits["momentum_error"]
        self._energy_limit = limits["energy_gain"]
        self._unpaid_limit = limits["unpaid_impulse"]
        self._lag_lowest = limits["lag_lowest"]
        self._lag_highest = limits["lag_highest"]
        self.on = stated or limits["fading"] > 0.0
        self.momentum_error = 0.0
        self.energy_gain = 0.0
        self.unpaid_impulse = 0.0
        self.restart()
        self.contacts = 0
        self.record = ContactCount(0, 0, 0, 0, 0, 0, OUT_OF_CONTACT, UNSTATED)

    def restart(self) -> None:
        """Forget the current contact and the past motion, but keep the results of the last audit."""
        self._has_motion = False
        self._open = False
        self._measured = False
        self._entry = [0.0] * AXES
        self._impulse = [0.0] * AXES
        self._pose = [0.0] * AXES
        self._twist = [0.0] * AXES
        self._work = 0.0
        self._quiet = 0.0
        self._ticks = 0.0
        self._statuses.restart()

    def tick(
        self,
        previous: Vector,
        status: int,
        lag: float,
        unpaid: float,
        wrench: Vector,
        pose: Vector,
        twist: Vector,
    ) -> int:
        """Process one tick and audit a contact that has ended; return the fault bits, 0 if none.

        Args:
            previous: wrench W_c of the last tick [N, N m].
            status: the compensator's status on the last tick.
            lag: lag of the hardware behind the model [s]; 0 if the compensator does not know it.
            unpaid: impulse error that remains after the contact, divided by the contact's impulse [1].
            wrench: measured wrench of this tick [N, N m].
            pose: pose of the numerical model [m, rad].
            twist: twist of the numerical model [m/s, rad/s].
        """
        if not self._has_motion:
            self._has_motion = True
            self._pose = list(pose)
            self._twist = list(twist)
        felt = length(wrench, [0.0] * AXES) > self._fading
        acts = status != OUT_OF_CONTACT if self._stated else felt
        fault = 0
        if acts and not self._open:
            self._begin()
            if lag != 0.0 and not self._lag_lowest <= lag <= self._lag_highest:
                fault = LAG
        is_open = self._open
        if is_open:
            self._account(previous, twist)
            self._statuses.take(status)
            self._measured = self._measured or felt
            self._ticks += 1.0
        self._pose = list(pose)
        self._twist = list(twist)
        if not is_open:
            return fault
        if acts:
            self._quiet = 0.0
        else:
            self._quiet += 1.0
            if self._quiet == 1.0:
                # If the contact has had several touches, keep the largest value.
                self.unpaid_impulse = max(self.unpaid_impulse, unpaid)
            if self._quiet >= self._quiet_ticks:
                return self._audit()
        if self._ticks > self._longest:
            fault |= CONTACT_TOO_LONG
        return fault

    def conclude(self, previous: Vector, status: int, unpaid: float) -> int:
        """Audit the current contact, if there is one; return the fault bits.

        Args:
            previous: wrench W_c of the last tick [N, N m].
            status: the compensator's status on the last tick.
            unpaid: impulse error that remains after the contact, divided by the contact's impulse [1].
        """
        if not self._open:
            return 0
        self._statuses.take(status)
        impulse = product(self._inverse, wrench_at_chaser(previous, self._pose))
        twist = add_multiple(self._twist, self._period, impulse)
        self._account(previous, twist)
        self._twist = twist
        self.unpaid_impulse = max(self.unpaid_impulse, unpaid)
        return self._audit()

    def detail(self, fatal: int) -> str:
        """Describe the last audit: contact number, and the value of each fault whose bit is in `fatal`."""
        numbers = {
            MOMENTUM: f"momentum error {self.momentum_error:.4g}",
            ENERGY_GAIN: f"energy released {self.energy_gain:.4g}",
            UNPAID_IMPULSE: f"unpaid impulse {self.unpaid_impulse:.4g}",
        }
        text = ", ".join(text for bit, text in numbers.items() if fatal & bit)
        return f"contact {self.contacts}: {text}" if text else ""

    def _begin(self) -> None:
        """Begin a contact; the twist on the last tick is the approach twist."""
        self._open = True
        self._entry = list(self._twist)
        self._impulse = [0.0] * AXES
        self._work = 0.0
        self._quiet = 0.0
        self._ticks = 0.0
        self._measured = False
        self._statuses.restart()
        self.unpaid_impulse = 0.0

    def _account(self, previous: Vector, twist: Vector) -> None:
        """Add the impulse and work of the last tick's wrench; `twist` is the twist after that tick."""
        wrench = wrench_at_chaser(previous, self._pose)
        self._impulse = add_multiple(self._impulse, self._period, wrench)
        self._work += self._period * 0.5 * (dot(wrench, self._twist) + dot(wrench, twist))

    def _audit(self) -> int:
        """End the contact and audit it; return the fault bits."""
        self._open = False
        self.contacts += 1
        fault = 0
        if self._stated:
            self.record = self._statuses.count(self.contacts, self._measured)
            if self.record.status != IDENTIFIED:
                fault = LAW_IN_DOUBT
        momentum = product(self._mass, self._entry)
        whole = dot(self._entry, momentum)
        error = subtract(product(self._mass, subtract(self._twist, self._entry)), self._impulse)
        allowed = self._size(self._impulse) + MOMENTUM_SHARE * _root(whole)
        size = self._size(error)
        self.momentum_error = size / allowed if allowed > 0.0 else size
        if not self.momentum_error <= self._momentum_limit:
            fault |= MOMENTUM
        self.energy_gain = 2.0 * self._work / whole if whole > 0.0 else self._work
        if not self.energy_gain <= self._energy_limit:
            fault |= ENERGY_GAIN
        if not self.unpaid_impulse <= self._unpaid_limit:
            fault |= UNPAID_IMPULSE
        return fault

    def _size(self, wrench: Vector) -> float:
        """Return the norm |W| = sqrt(W . M^-1 W) of a wrench or an impulse."""
        return _root(dot(wrench, product(self._inverse, wrench)))


def _root(square: float) -> float:
    """Return the square root, or 0 if rounding has made the argument negative."""
    if square < 0.0:
        return 0.0
    return sqrt(square)
