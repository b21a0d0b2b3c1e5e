"""Options of `tuning.sweep` and `jaxhil sweep`."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import arg

from jaxhil.errors import format_value
from jaxhil.mechanism.file import AnyMechanism
from tuning.api import arguments
from tuning.api.arguments import ArgumentError
from tuning.api.options import (
    AllowedValues,
    OptionalLimit,
    Resume,
    Scheduler,
    check_options,
    number_option,
    text_option,
)
from tuning.sweeps import MAX_CHUNK_SIZE, MAX_SCENARIOS, MAX_SEED, PRECISIONS, SAMPLINGS

MAX_SOBOL_SCENARIOS = 2**20  # largest number of scenarios for the Sobol indices of each input
DEFAULT_SOBOL_SCENARIOS = 1024  # number of scenarios for the Sobol indices of each input, a power of two


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Options of `sweep`."""

    scenarios: Annotated[
        int, number_option("Scenarios to draw and run."), AllowedValues(1, MAX_SCENARIOS)
    ] = 100_000
    seed: Annotated[
        int,
        number_option("Seed of the scenarios; scenario i depends only on the seed and on i."),
        AllowedValues(0, MAX_SEED),
    ] = 0
    sampling: Annotated[
        str,
        arg(metavar="NAME", help="Sampling: random, or sobol (several replicates of scrambled sequences)."),
        AllowedValues(names=SAMPLINGS),
    ] = "random"
    precision: Annotated[
        str,
        arg(
            metavar="NAME",
            help="float64; or float32, which is faster and is compared with float64 on a subset.",
        ),
        AllowedValues(names=PRECISIONS),
    ] = "float64"
    works: Annotated[
        bool,
        arg(
            name="works",
            metavar="",
            help="Also compute the mechanical work of the real force to 1e-6; this is tens of times slower.",
        ),
    ] = False
    limit: OptionalLimit = None
    until_width: Annotated[
        float | None,
        text_option(
            "WIDTH",
            "Stop as soon as the failure probability's interval is at most this wide, or after --scenarios.",
        ),
        AllowedValues(math.ulp(0.0), 1.0, words="a width above 0, at most 1"),
    ] = None
    drivers: Annotated[
        int | None,
        text_option(
            "[NUMBER]",
            "Also compute Sobol indices of the error, from this number of scenarios (a power of two); "
            f"without a number from {DEFAULT_SOBOL_SCENARIOS}.",
        ),
        AllowedValues(2, MAX_SOBOL_SCENARIOS, words=f"a power of two, 2 to {MAX_SOBOL_SCENARIOS}"),
    ] = None
    rare: Annotated[
        float | None,
        text_option(
            "[LIMIT]",
            "Also estimate the probability of rare errors above this limit by subset simulation; without a "
            "number, or for 0, the limit is --limit.",
        ),
    ] = None
    acceptable: Annotated[
        float | None,
        text_option(
            "PROBABILITY",
            "Acceptable failure probability, for the interval's upper end; by default no scenario may fail.",
        ),
        AllowedValues(0.0, 1.0, words="a probability, 0 to 1"),
    ] = None
    resume: Resume = False
    chunk: Annotated[
        int,
        number_option("Number of scenarios that are computed together and stored as one chunk."),
        AllowedValues(1, MAX_CHUNK_SIZE),
    ] = 16384
    scheduler: Scheduler = None

    def check(self) -> None:
        """Raise `InputError` if the value of an option or a combination of options is not allowed."""
        check_options(self)
        if self.until_width is not None and self.sampling != "random":
            raise ArgumentError("until_width", f"sampling {self.sampling}", "sampling random")
        if self.drivers is not None and self.drivers & (self.drivers - 1):
            raise ArgumentError("drivers", str(self.drivers), f"a power of two, 2 to {MAX_SOBOL_SCENARIOS}")
        if self.rare is not None:
            self._check_rare(self.rare, 0.0 if self.limit is None else self.limit)

    def with_limit(self, mechanism: AnyMechanism) -> "SweepOptions":
        """Return the options with an error limit; by default, the one for the mechanism's number of axes."""
        limit = arguments.choose_limit(self.limit, mechanism)
        if self.rare is not None:
            self._check_rare(self.rare, limit)
        return dataclasses.replace(self, limit=limit)

    def _check_rare(self, rare: float, limit: float) -> None:
        """Raise `InputError` unless `rare` is 0 or an error of at least the limit."""
        is_number = arguments.is_number(rare)
        if not (is_number and (rare == 0 or (math.isfinite(rare) and rare >= limit))):
            raise ArgumentError("rare", _format_value(rare), "a finite error, at least --limit")
        if rare == 0 and not math.isfinite(limit):
            raise ArgumentError("rare", "an infinite --limit", "a finite --limit")


def _format_value(value: Any) -> str:
    """Return an option's value, which may not be a number, as text for an error message."""
    return str(value) if arguments.is_number(value) else format_value(value)
