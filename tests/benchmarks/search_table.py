"""Success rate and cost of several optimisers, computed from their traces.

A start succeeds if its relative distance from the best loss of all methods and starts is at most `CLOSE`. If
a share p of the starts succeeds at a median cost c, the expected cost of restarts until success is c/p.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from search_methods import Trace

CLOSE = 0.01


class Success(NamedTuple):
    """Success rate and cost of an optimiser on one mechanism.

    `share` of starts that succeed; expected `rollouts` and `seconds` until the first success, inf without
    success; `best` and `median` final loss over the starts as a multiple of the best loss of all methods;
    `rollouts_done` and `seconds_done` per start.
    """

    share: float
    rollouts: float
    seconds: float
    best: float
    median: float
    rollouts_done: float
    seconds_done: float


Results = Mapping[str, Success]


def rate_methods(traces: Mapping[str, Sequence[Trace]]) -> tuple[float, dict[str, Success]]:
    """Return the best loss of all methods, and the success of every method on one mechanism."""
    best = min(float(np.min(trace.loss)) for several in traces.values() for trace in several)
    return best, {name: _success(several, best) for name, several in traces.items()}


def medians(results: Sequence[Results]) -> dict[str, Success]:
    """Return the median over mechanisms for every method."""
    return {name: Success(*np.median([one[name] for one in results], axis=0).tolist()) for name in results[0]}


def ratios(ours: Success, others: Sequence[Success]) -> tuple[float, float]:
    """Return expected rollouts and seconds of `ours` divided by those of the best other method."""

    def ratio(field: str) -> float:
        value, best = getattr(ours, field), min(getattr(other, field) for other in others)
        return value / best if np.isfinite(value) else np.inf

    return ratio("rollouts"), ratio("seconds")


def table(results: Results) -> str:
    """Return a table with one line per method; losses are stated relative to the best loss."""
    lines = [
        f"{'':24}{'starts that':>12}  {'to be expected':>19}  {'loss above best':>17}"
        f"  {'spent on a start':>19}",
        f"{'':24}{'succeed':>12}  {'rollouts':>9} {'seconds':>9}  {'least':>8} {'median':>8}"
        f"  {'rollouts':>9} {'seconds':>9}",
    ]
    for name, success in results.items():
        lines.append(
            f"{name:24}{success.share:>12.0%}  {success.rollouts:>9.0f} {success.seconds:>9.2f}"
            f"  {success.best - 1:>8.1%} {success.median - 1:>8.1%}"
            f"  {success.rollouts_done:>9.0f} {success.seconds_done:>9.2f}"
        )
    return "\n".join(lines)


def _success(traces: Sequence[Trace], best: float) -> Success:
    ends = np.array([trace.loss[-1] for trace in traces]) / best
    # Losses decrease, so this is the first entry that is close enough.
    first = [int(np.argmax(trace.loss <= (1 + CLOSE) * best)) for trace in traces]
    successes = [(trace, i) for trace, i, end in zip(traces, first, ends, strict=True) if end <= 1 + CLOSE]
    share = len(successes) / len(traces)

    def expected(field: str) -> float:
        return (
            float(np.median([getattr(trace, field)[i] for trace, i in successes])) / share
            if successes
            else np.inf
        )

    return Success(
        share=share,
        rollouts=expected("rollouts"),
        seconds=expected("seconds"),
        best=float(np.min(ends)),
        median=float(np.median(ends)),
        rollouts_done=float(np.median([trace.rollouts[-1] for trace in traces])),
        seconds_done=float(np.median([trace.seconds[-1] for trace in traces])),
    )
