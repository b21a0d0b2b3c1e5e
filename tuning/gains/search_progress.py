"""Progress report of a long search, with checkpoints from which an interrupted search continues.

Work is counted in simulated runs. One evaluation of one scenario is one run; its Jacobian with respect to P
gains counts as 1 + P runs. The total number of runs is an estimate, because convergence cannot be predicted.
"""

from collections.abc import Callable
from typing import Any

from tuning.caches.checkpoints import NO_CHECKPOINTS, StepCheckpoints

# The callback's arguments are the description of the current stage, the completed share of all work, and the
# share of all work that was read from the cache (0 to 1).
SearchProgressCallback = Callable[[str, float, float], None]


class SearchProgress:
    """Progress counter of a search, to which every part of the search reports its completed runs."""

    def __init__(self, tell: SearchProgressCallback = lambda text, share, cached: None):
        self._tell = tell
        self.name = ""  # name of the current group of mechanisms
        self.runs_after_group = 0.0  # number of runs that remain after the current group
        self.journal: StepCheckpoints = NO_CHECKPOINTS.journal("", None)  # checkpoints of the group's steps
        # callback before a search, with its estimated number of runs
        self.announce: Callable[[float], None] = lambda runs: None
        self._text, self._kept, self._done, self._left = "", 0.0, 0.0, 0.0

    @property
    def computed_runs(self) -> float:
        """Return the number of runs that were simulated, without results from the cache."""
        return self._done

    def keep(self, text: str, runs: float) -> None:
        """Count the `runs` runs of the current group as read from the cache, and report this as `text`."""
        self._kept += runs
        self.begin(text, 0.0)

    def begin(self, text: str, left: float) -> None:
        """Begin the stage `text`; `left` runs remain for the current group, including those of this stage."""
        self._left = left
        self.say(text)

    def say(self, text: str) -> None:
        self._text = f"{self.name}: {text}" if self.name else text
        self._show()

    def report_runs(self, runs: float) -> None:
        self._done += runs
        self._left = max(self._left - runs, 0.0)
        self._show()

    def step(self, name: str, kind: Any, make: Callable[[], Any]) -> Any:
        """Read a step's result, of type `kind`, from a checkpoint; without one, call `make` and save it."""
        return self.journal.step(name, kind, make)

    def _show(self) -> None:
        total = self._kept + self._done + self._left + self.runs_after_group
        done, cached = ((self._kept + self._done) / total, self._kept / total) if total > 0 else (0.0, 0.0)
        self._tell(self._text, done, cached)
