"""Status of a law: what it says of its own command after each tick, and what that comes to over a contact.

Every status is one number, the same in the C controller. `STATUSES` is the table that documentation and
exports are made from. Over a contact the statuses are counted, and the contact is

    not reached    where no force was measured, whatever the law did,
    unsure         where the law did not act at all,
    unsure, too short or noisy
                   else by the most frequent, where the law was any of them on more than `DOUBTFUL` of the
                   ticks on which it acted,
    unexplained or saturated
                   else, where it was so on the last of them: what the law knows once the contact is over,
    identified     else.

In all but the last case the law could not identify the contact, or the correction had little time or room.
How often an identified contact errs: `pytest -m slow -s tests/test_law_status.py`.
"""

from typing import NamedTuple

from jaxhil.rig.types import SmallInt

DOUBTFUL = 0.4  # of the ticks on which the law acts


class Status(NamedTuple):
    """Status of a law."""

    number: int
    name: str
    meaning: str


OUT_OF_CONTACT, IDENTIFIED, UNSURE, SATURATED, TOO_SHORT, UNSTATED = range(6)
NOISY, NOT_REACHED, UNEXPLAINED = 7, 8, 9  # 6 was `displaced`, of laws that are retired

STATUSES = (
    Status(OUT_OF_CONTACT, "out_of_contact", "the law does not act"),
    Status(IDENTIFIED, "identified", "the command is that of a contact that has been identified"),
    Status(UNSURE, "unsure", "nothing is identified yet, or there is nothing to scale by"),
    Status(SATURATED, "saturated", "identified, and the correction is at its limit"),
    Status(
        TOO_SHORT,
        "too_short",
        "half of the contact was over when the hardware entered: little time is left",
    ),
    Status(UNSTATED, "unstated", "the law says nothing of itself"),
    Status(NOISY, "noisy", "noise of force or position, or a dead zone, leaves the contact uncertain"),
    Status(NOT_REACHED, "not_reached", "said of a whole contact: no force was measured, so there was none"),
    Status(
        UNEXPLAINED,
        "unexplained",
        "the contact's energies do not balance: unmodelled delay, lag or friction",
    ),
)
STATUS_NAMES = {status.number: status.name for status in STATUSES}


class ContactCount(NamedTuple):
    """Statuses of one contact: the number of ticks with each, and the one that counts."""

    number: int  # of the contact; 0 before the first
    ticks: int  # on which the law acted
    unsure: int  # of these, the ticks with that status; so with the others that are counted
    saturated: int
    too_short: int
    noisy: int
    last: SmallInt  # status on the last tick on which the law acted
    status: SmallInt  # what counts


class ContactRecord(NamedTuple):
    """Statuses of one contact, by name."""

    number: int = 0  # of the contact; 0 before the first
    status: str = STATUS_NAMES[UNSTATED]  # what counts, one of `STATUSES` by name
    ticks: int = 0  # on which the law acted
    unsure: int = 0  # of these, the ticks with that status; so with the others that are counted
    saturated: int = 0
    too_short: int = 0
    noisy: int = 0

    @property
    def in_doubt(self) -> bool:
        """Whether the law could not know the contact, or had too little time or room to correct it."""
        return self.status not in (STATUS_NAMES[UNSTATED], STATUS_NAMES[IDENTIFIED])


def contact_record(count: ContactCount) -> ContactRecord:
    """Return the record of a contact with the status by its name."""
    number, ticks, unsure, saturated, too_short, noisy, _, status = count
    return ContactRecord(number, STATUS_NAMES[status], ticks, unsure, saturated, too_short, noisy)


class StatusCount:
    """On how many ticks of a contact a law said what."""

    __slots__ = ("_last", "_noisy", "_saturated", "_ticks", "_too_short", "_unsure")

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Another contact."""
        self._ticks = 0
        self._unsure = 0
        self._saturated = 0
        self._too_short = 0
        self._noisy = 0
        self._last = OUT_OF_CONTACT

    def take(self, status: int) -> None:
        """One tick's status."""
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
        """Return the count of contact `number`, which is over; `measured`: whether there was a force."""
        ticks, unsure, too_short, noisy = self._ticks, self._unsure, self._too_short, self._noisy
        status = IDENTIFIED
        if not measured:
            status = NOT_REACHED
        elif ticks == 0:
            status = UNSURE
        elif unsure + too_short + noisy > DOUBTFUL * ticks:
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
