"""Status of a compensator after each tick, and status of a whole contact.

Every status is one number, the same in the C controller. The table `STATUSES` is the source of documentation
and exports. Over a contact the statuses are counted. The first condition that holds gives its status:

    not_reached    no force was measured
    unsure         the compensator did not act at all
    unsure, too_short or noisy
                   their ticks are more than `MAX_DOUBTFUL_SHARE` of the ticks on which the compensator acted:
                   the most frequent of the three
    unexplained or saturated
                   it was the status of the last tick on which the compensator acted
    identified     otherwise

Unless it is identified, the compensator did not identify the contact, or its correction had little time or
was at its limit.
"""

from typing import NamedTuple

from jaxhil.rig.types import SmallInt

MAX_DOUBTFUL_SHARE = 0.4  # share of the ticks on which the compensator acts


class Status(NamedTuple):
    """Status of a compensator."""

    number: int  # same in C
    name: str  # name in texts and exports
    meaning: str  # one line


OUT_OF_CONTACT, IDENTIFIED, UNSURE, SATURATED, TOO_SHORT, UNSTATED = range(6)
NOISY, NOT_REACHED, UNEXPLAINED = 7, 8, 9  # 6 was `displaced`, of retired laws

STATUSES = (
    Status(OUT_OF_CONTACT, "out_of_contact", "the law does not act"),
    Status(IDENTIFIED, "identified", "the command follows from an identified contact"),
    Status(UNSURE, "unsure", "nothing is identified yet, or the approach speed is unknown"),
    Status(SATURATED, "saturated", "identified, and the correction is at its limit"),
    Status(
        TOO_SHORT,
        "too_short",
        "most of the contact was over when the hardware touched: little time is left",
    ),
    Status(UNSTATED, "unstated", "the law has no status"),
    Status(NOISY, "noisy", "noise of force or position, or a dead zone, leaves the contact uncertain"),
    Status(NOT_REACHED, "not_reached", "status of a whole contact: no force was measured in it"),
    Status(
        UNEXPLAINED,
        "unexplained",
        "the contact's energies do not balance: unmodelled delay, lag or friction",
    ),
)
STATUS_NAMES = {status.number: status.name for status in STATUSES}


class ContactCount(NamedTuple):
    """Statuses of one contact: the number of ticks with each, and that of the whole contact."""

    number: int  # of the contact; 0 before the first
    ticks: int  # on which the compensator acted
    unsure: int  # ticks with this status, likewise below
    saturated: int
    too_short: int
    noisy: int
    last: SmallInt  # status of the last tick on which the compensator acted
    status: SmallInt  # of the whole contact


class ContactRecord(NamedTuple):
    """Statuses of one contact, by name."""

    number: int = 0  # of the contact; 0 before the first
    status: str = STATUS_NAMES[UNSTATED]  # of the whole contact, a name in `STATUSES`
    ticks: int = 0  # on which the compensator acted
    unsure: int = 0  # ticks with this status, likewise below
    saturated: int = 0
    too_short: int = 0
    noisy: int = 0

    @property
    def in_doubt(self) -> bool:
        """Return whether the compensator has a status and did not fully identify and correct the contact."""
        return self.status not in (STATUS_NAMES[UNSTATED], STATUS_NAMES[IDENTIFIED])


def contact_record(count: ContactCount) -> ContactRecord:
    """Return the record of a contact, with the name of its status."""
    number, ticks, unsure, saturated, too_short, noisy, _, status = count
    return ContactRecord(number, STATUS_NAMES[status], ticks, unsure, saturated, too_short, noisy)


class StatusCount:
    """Counter of a compensator's statuses over a contact."""

    __slots__ = ("_last", "_noisy", "_saturated", "_ticks", "_too_short", "_unsure")

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin another contact."""
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
        """Return the counts of contact `number`, which is over; `measured`: whether a force was measured."""
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
