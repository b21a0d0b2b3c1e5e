"""Status of a compensator after each tick, and status of a whole contact.

Each status is a number, which is the same in the C controller. Documentation and exports are made from the
table `STATUSES`. The status of a whole contact is the first in this list whose condition holds:

    not_reached    no force was measured
    unsure         the compensator never acted
    unsure, too_short or noisy
                   together, these three statuses occurred on more than `MAX_DOUBTFUL_SHARE` of the ticks on
                   which the compensator acted; the contact gets the most frequent of the three
    unexplained or saturated
                   it was the status of the last tick on which the compensator acted
    identified     none of the conditions above holds

Every status except `identified` means that the compensator did not identify the contact, or that its
correction had little time or reached its limit.
"""

from typing import NamedTuple

from jaxhil.rig.types import SmallInt

MAX_DOUBTFUL_SHARE = 0.4  # limit on the share of ticks with a doubtful status


class Status(NamedTuple):
    """Entry of the status table: number, name and meaning."""

    number: int  # number in Python and C
    name: str  # name in texts and exports
    meaning: str  # description in one line


OUT_OF_CONTACT, IDENTIFIED, UNSURE, SATURATED, TOO_SHORT, UNSTATED = range(6)
NOISY, NOT_REACHED, UNEXPLAINED = 7, 8, 9  # 6 was a status of retired compensators

STATUSES = (
    Status(OUT_OF_CONTACT, "out_of_contact", "the compensator does not act"),
    Status(IDENTIFIED, "identified", "the command uses an identified contact"),
    Status(UNSURE, "unsure", "no contact is identified yet, or the approach speed is unknown"),
    Status(SATURATED, "saturated", "the contact is identified, and the correction is at its limit"),
    Status(
        TOO_SHORT,
        "too_short",
        "most of the contact had passed when the hardware touched: little time remains for the correction",
    ),
    Status(UNSTATED, "unstated", "the compensator has no status"),
    Status(NOISY, "noisy", "noise of force or position, or a dead zone, makes the identification uncertain"),
    Status(NOT_REACHED, "not_reached", "only for a whole contact: no force was measured in the contact"),
    Status(
        UNEXPLAINED,
        "unexplained",
        "the contact's energies do not balance: unmodelled delay, lag or friction",
    ),
)
STATUS_NAMES = {status.number: status.name for status in STATUSES}


class ContactCount(NamedTuple):
    """Numbers of ticks with each compensator status in one contact, and the status of the contact."""

    number: int  # number of the contact; 0 before the first contact
    ticks: int  # number of ticks on which the compensator acted
    unsure: int  # number of ticks with the status `unsure`
    saturated: int  # number of ticks with the status `saturated`
    too_short: int  # number of ticks with the status `too_short`
    noisy: int  # number of ticks with the status `noisy`
    last: SmallInt  # status of the last tick on which the compensator acted
    status: SmallInt  # status of the whole contact


class ContactRecord(NamedTuple):
    """Record of one contact for users: the compensator's status, and the ticks with each doubtful status.

    Attributes:
        number: number of the contact; 0 before the first contact.
        status: status of the whole contact, a name in `STATUSES`.
        ticks: number of ticks on which the compensator acted.
        unsure: number of ticks with the status `unsure`.
        saturated: number of ticks with the status `saturated`.
        too_short: number of ticks with the status `too_short`.
        noisy: number of ticks with the status `noisy`.
    """

    number: int = 0
    status: str = STATUS_NAMES[UNSTATED]
    ticks: int = 0
    unsure: int = 0
    saturated: int = 0
    too_short: int = 0
    noisy: int = 0

    @property
    def in_doubt(self) -> bool:
        """Return whether the compensator reports a status other than `identified` for the contact."""
        return self.status not in (STATUS_NAMES[UNSTATED], STATUS_NAMES[IDENTIFIED])


def contact_record(count: ContactCount) -> ContactRecord:
    """Convert the counts of a contact to a `ContactRecord`, with the status as a name."""
    number, ticks, unsure, saturated, too_short, noisy, _, status = count
    return ContactRecord(number, STATUS_NAMES[status], ticks, unsure, saturated, too_short, noisy)


class StatusCount:
    """Counter of the ticks with each compensator status during one contact."""

    __slots__ = ("_last", "_noisy", "_saturated", "_ticks", "_too_short", "_unsure")

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Set all counts to 0 for the next contact."""
        self._ticks = 0
        self._unsure = 0
        self._saturated = 0
        self._too_short = 0
        self._noisy = 0
        self._last = OUT_OF_CONTACT

    def take(self, status: int) -> None:
        """Count one tick's status."""
        if status in (UNSTATED, OUT_OF_CONTACT):
            return
        self._ticks += 1
        self._last = status
        if status == IDENTIFIED:
            return
        if status == UNSURE:
            self._unsure += 1
        elif status == SATURATED:
            self._saturated += 1
        elif status == TOO_SHORT:
            self._too_short += 1
        elif status == NOISY:
            self._noisy += 1

    def count(self, number: int, measured: bool) -> ContactCount:
        """Return counts and status of the contact that has ended.

        Args:
            number: number of the contact.
            measured: whether a force was measured in the contact.
        """
        ticks, unsure, too_short, noisy = self._ticks, self._unsure, self._too_short, self._noisy
        status = IDENTIFIED
        if not measured:
            status = NOT_REACHED
        elif ticks == 0:
            status = UNSURE
        elif unsure + too_short + noisy > MAX_DOUBTFUL_SHARE * ticks:
            status = UNSURE
            most = unsure
            if too_short > most:
                status = TOO_SHORT
                most = too_short
            if noisy > most:
                status = NOISY
        elif self._last in (UNEXPLAINED, SATURATED):
            status = self._last
        return ContactCount(number, ticks, unsure, self._saturated, too_short, noisy, self._last, status)
