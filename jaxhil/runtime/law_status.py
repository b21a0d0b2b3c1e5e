"""What a law says of its own command: its status after each tick, and what that comes to over a contact.

Every status is one number, the same in the C controller. `STATUSES` is the table that documentation and
exports are made from. Over a contact they are counted, and the contact is

    not reached    where no force was measured, whatever the law did,
    unsure         where the law did not act at all,
    unsure, too short, displaced or noisy
                   else by the most frequent, where the law was any of them on more than `DOUBTFUL` of the
                   ticks on which it acted,
    unexplained or saturated
                   else, where it was so on the last of them: what the law knows once the contact is over,
    identified     else.

In all but the last case the law could not know the contact, or the correction had little time or room. Until
the hardware has entered, every contact is unsure: of 1835 contacts of the standard suites that the law never
called too short, none was in doubt for more than 0.29 of its ticks; of 165 that it did, 19 in 20 are for 0.67
and more. `DOUBTFUL` lies between. With the contact plane wrong by 1 mm, the force 1 ms older than told, a lag
of the force sensor of 1 or 3 ms untold, position noise of 1 ms x v0 or the published rig's noise and dead
zone, at most one contact in 100 is called identified and errs by more than 1.5 %; with nothing wrong 99 in
100 are identified. Contact with a damper is not among them: a lag that takes as much energy as the damper
gives makes it contact without one. Of 60 such contacts retrospective_reference calls 55 identified, behind a
lag of 1 ms 13, 11 of them wrongly, and of 3 ms 6, all of them wrongly.
Figures: `pytest -m slow -s tests/test_law_status.py`.
"""

from typing import NamedTuple

DOUBTFUL = 0.4  # of the ticks on which the law acts


class Status(NamedTuple):
    """A status: its name, what it says."""

    name: str
    meaning: str


(
    OUT_OF_CONTACT,
    IDENTIFIED,
    UNSURE,
    SATURATED,
    TOO_SHORT,
    UNSTATED,
    DISPLACED,
    NOISY,
    NOT_REACHED,
    UNEXPLAINED,
) = range(10)
DOUBTS = UNSURE, TOO_SHORT, DISPLACED, NOISY

STATUSES = (
    Status("out_of_contact", "the law does not act"),
    Status("identified", "the command is that of a contact that has been identified"),
    Status("unsure", "nothing is identified yet, or there is nothing to scale by"),
    Status("saturated", "identified, and the correction is at its limit"),
    Status("too_short", "the hardware entered when half of the contact was over: little time is left"),
    Status("unstated", "the law says nothing of itself"),
    Status("displaced", "the surface lies farther from where it was told than it was told to lie at most"),
    Status("noisy", "noise of force or position, or a dead zone, leaves the contact uncertain"),
    Status("not_reached", "said of a whole contact: no force was measured, so that there was none"),
    Status("unexplained", "energy, onset or turning are not a contact's: delay, lag or friction untold"),
)

_NAMES = tuple(status.name for status in STATUSES)


class ContactRecord(NamedTuple):
    """What the law said of one contact."""

    number: int = 0  # of the contact; 0 before the first
    status: str = _NAMES[UNSTATED]  # what counts, one of `STATUSES` by name
    ticks: int = 0  # on which the law acted
    unsure: int = 0  # of these, the ticks with that status; so with the others that are counted
    saturated: int = 0
    too_short: int = 0
    displaced: int = 0
    noisy: int = 0

    @property
    def in_doubt(self) -> bool:
        """Whether the law could not know the contact, or had too little time or room to correct it."""
        return self.status not in (_NAMES[UNSTATED], _NAMES[IDENTIFIED])


class StatusCount:
    """On how many ticks of a contact a law said what."""

    __slots__ = ("_counts", "_last")

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Another contact."""
        self._counts = [0] * len(STATUSES)
        self._last = OUT_OF_CONTACT

    def take(self, status: int) -> None:
        """One tick's status."""
        self._counts[status] += 1
        if status not in (UNSTATED, OUT_OF_CONTACT):
            self._last = status

    def record(self, number: int, measured: bool) -> ContactRecord:
        """Contact `number`, now that it is over, and whether a force was `measured` in it."""
        counts = self._counts
        doubts = [counts[status] for status in DOUBTS]
        ticks = sum(counts) - counts[UNSTATED] - counts[OUT_OF_CONTACT]
        status = IDENTIFIED
        if not measured:
            status = NOT_REACHED
        elif ticks == 0:
            status = UNSURE
        elif sum(doubts) > DOUBTFUL * ticks:
            status = DOUBTS[doubts.index(max(doubts))]
        elif self._last in (UNEXPLAINED, SATURATED):
            status = self._last
        unsure, *others = doubts
        return ContactRecord(number, _NAMES[status], ticks, unsure, counts[SATURATED], *others)
