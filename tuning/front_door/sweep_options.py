"""Options of `tuning.sweep` and `jaxhil sweep`."""

import math
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import arg

from jaxhil.errors import shown
from tuning.front_door import arguments
from tuning.front_door.arguments import ArgumentError
from tuning.front_door.options import Allowed, Limit, Resume, Scheduler, check_options, number, text
from tuning.sweeps import LARGEST_CHUNK, LARGEST_SEED, MOST, PRECISIONS, SAMPLINGS

MOST_DRIVERS = 2**20  # largest number of scenarios for each input
DEFAULT_DRIVERS = 1024


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Options of `sweep`."""

    scenarios: Annotated[int, number("Scenarios to draw and run."), Allowed(1, MOST)] = 100_000
    seed: Annotated[
        int, number("Seed; scenario i depends only on the seed and on i."), Allowed(0, LARGEST_SEED)
    ] = 0
    sampling: Annotated[
        str,
        arg(metavar="NAME", help="random, or sobol (scrambled, several replicates)."),
        Allowed(names=SAMPLINGS),
    ] = "random"
    precision: Annotated[
        str,
        arg(metavar="NAME", help="float64, or float32: faster, and compared with float64 on a subset."),
        Allowed(names=PRECISIONS),
    ] = "float64"
    works: Annotated[
        bool,
        arg(
            name="works",
            metavar="",
            help="Also compute the mechanical work of the real force, to 1e-6; tens of times slower.",
        ),
    ] = False
    limit: Limit = 0.01
    until_width: Annotated[
        float | None,
        text("WIDTH", "Stop once the probability's interval is this narrow, or after --scenarios."),
        Allowed(math.ulp(0.0), 1.0, words="a width above 0, at most 1"),
    ] = None
    drivers: Annotated[
        int | None,
        text(
            "[NUMBER]",
            f"Also Sobol indices of the error, from a power of two of scenarios; bare: {DEFAULT_DRIVERS}.",
        ),
        Allowed(2, MOST_DRIVERS, words=f"a power of two, 2 to {MOST_DRIVERS}"),
    ] = None
    rare: Annotated[
        float | None,
        text("[LIMIT]", "Also subset simulation of rare errors beyond this limit; bare, or 0: --limit."),
    ] = None
    acceptable: Annotated[
        float | None,
        text(
            "PROBABILITY",
            "Failure probability that the interval may reach; by default no run may fail.",
        ),
        Allowed(0.0, 1.0, words="a probability, 0 to 1"),
    ] = None
    resume: Resume = False
    chunk: Annotated[
        int,
        number("Scenarios computed at a time, and rows of each chunk of the store."),
        Allowed(1, LARGEST_CHUNK),
    ] = 16384
    scheduler: Scheduler = None

    def check(self) -> None:
        """Check all options. Raise `InputError`."""
        check_options(self)
        if self.until_width is not None and self.sampling != "random":
            raise ArgumentError("until_width", f"with --sampling {self.sampling}", "with random")
        if self.drivers is not None and self.drivers & (self.drivers - 1):
            raise ArgumentError("drivers", str(self.drivers), f"a power of two, 2 to {MOST_DRIVERS}")
        if (rare := self.rare) is not None:
            is_number = arguments.is_number(rare)
            if not (is_number and (rare == 0 or (math.isfinite(rare) and rare >= self.limit))):
                raise ArgumentError("rare", _shown(rare), "a finite error, at least --limit")
            if rare == 0 and not math.isfinite(self.limit):
                raise ArgumentError("rare", "without a limit", "with a finite --limit")


def _shown(value: Any) -> str:
    """Return a value as text for a message."""
    return str(value) if arguments.is_number(value) else shown(value)
