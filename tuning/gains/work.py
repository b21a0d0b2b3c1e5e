"""A search of minutes under way: the share of it that is done, and the steps that an interruption spares.

What takes the time is simulated runs: of a batch of scenarios under some gains as many as there are
scenarios, of a Jacobian over P gains 1 + P times as many. How many a search takes is known beforehand but for
how soon it converges.
"""

from collections.abc import Callable
from typing import Any

from tuning.caches.pieces import NOTHING_KEPT, Journal

# Called with what is going on, the share of all the work that is done, 0 to 1, and the share that was kept
# from before.
Tell = Callable[[str, float, float], None]


class Work:
    """The work that a search has before it; whoever does some of it says so."""

    def __init__(self, tell: Tell = lambda text, share, kept: None):
        self._tell = tell
        self.name = ""  # of what is under way
        self.later = 0.0  # runs that come after it
        self.journal: Journal = NOTHING_KEPT.journal("", None)  # its steps
        self._text, self._kept, self._done, self._left = "", 0.0, 0.0, 0.0

    def keep(self, text: str, runs: float) -> None:
        """What is under way was done before; it took about so many runs."""
        self._kept += runs
        self.begin(text, 0.0)

    def begin(self, text: str, left: float) -> None:
        """A stage begins; of what is under way so many runs are left, with its own."""
        self._left = left
        self.say(text)

    def say(self, text: str) -> None:
        """What is going on."""
        self._text = f"{self.name}: {text}" if self.name else text
        self._show()

    def ran(self, runs: float) -> None:
        """So many runs are done."""
        self._done += runs
        self._left = max(self._left - runs, 0.0)
        self._show()

    def step(self, name: str, kind: Any, make: Callable[[], Any]) -> Any:
        """What `make` gives, a `kind`: kept from before an interruption, or made now."""
        return self.journal.step(name, kind, make)

    def _show(self) -> None:
        whole = self._kept + self._done + self._left + self.later
        done, kept = ((self._kept + self._done) / whole, self._kept / whole) if whole > 0 else (0.0, 0.0)
        self._tell(self._text, done, kept)
