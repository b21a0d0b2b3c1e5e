"""Progress of a long search, and checkpoints of its steps for a restart after an interruption.

Work is counted in simulated runs: one per scenario of a batch, and 1 + P per scenario of a Jacobian over P
gains. The number of runs of a search is known beforehand except for its convergence.
"""

from collections.abc import Callable
from typing import Any

from tuning.caches.checkpoints import NO_CHECKPOINTS, StepCheckpoints

# Arguments: description of the current stage, share of all work that is done (0 to 1), and share that came
# from the cache.
SearchProgressCallback = Callable[[str, float, float], None]


class SearchProgress:
    """Progress counter of a search; code that does some of the work reports it here."""

    def __init__(self, tell: SearchProgressCallback = lambda text, share, cached: None):
        self._tell = tell
        self.name = ""  # name of the current block
        self.runs_after_group = 0.0  # runs after the current block
        self.journal: StepCheckpoints = NO_CHECKPOINTS.journal("", None)  # checkpoints of the block's steps
        self._text, self._kept, self._done, self._left = "", 0.0, 0.0, 0.0

    def keep(self, text: str, runs: float) -> None:
        """Report that the current block, of about so many runs, came from the cache."""
        self._kept += runs
        self.begin(text, 0.0)

    def begin(self, text: str, left: float) -> None:
        """Begin a stage; `left` runs of the current block remain, those of the stage included."""
        self._left = left
        self.say(text)

    def say(self, text: str) -> None:
        """Show the description of the current stage."""
        self._text = f"{self.name}: {text}" if self.name else text
        self._show()

    def report_runs(self, runs: float) -> None:
        """Report `runs` completed runs."""
        self._done += runs
        self._left = max(self._left - runs, 0.0)
        self._show()

    def step(self, name: str, kind: Any, make: Callable[[], Any]) -> Any:
        """Return the result of `make`, of type `kind`, or its checkpoint from before an interruption."""
        return self.journal.step(name, kind, make)

    def _show(self) -> None:
        total = self._kept + self._done + self._left + self.runs_after_group
        done, cached = ((self._kept + self._done) / total, self._kept / total) if total > 0 else (0.0, 0.0)
        self._tell(self._text, done, cached)
