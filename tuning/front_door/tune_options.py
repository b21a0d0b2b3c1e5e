"""Options of `tuning.tune` and `jaxhil tune`."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from jaxhil.errors import one_line
from jaxhil.mechanism.file import AnyMechanism
from tuning.front_door import arguments, tune_pareto
from tuning.front_door.arguments import ArgumentError
from tuning.front_door.options import Allowed, Limit, Scheduler, Seed, Setting, check_options, number, text

if TYPE_CHECKING:
    from tuning.gains.objective import Objective
    from tuning.gains.settings import TuneSettings
    from tuning.gains.transfer import Tuned

    # The command line takes names; the function also takes results and functions.
    Start = Any
    ObjectiveOption = str | Callable[[Any], Any]
else:
    Start = tuple[str, ...]
    ObjectiveOption = str

Count = Allowed(1)
Weight = float | None


@dataclass(frozen=True, kw_only=True)
class TuneOptions:
    """Options of `tune`."""

    compensator: Annotated[str, arg(metavar="NAME", help="Compensator to tune.")] = "response_error"
    setting: Setting = None
    scenarios: Annotated[
        int | None,
        text("NUMBER", "Scenarios to tune on; by default 32, or 128 where sensors are noisy."),
        Count,
    ] = None
    starts: Annotated[
        int, number("Starts of the solver, and of each further lot where they disagree."), Count
    ] = 4
    start: Annotated[
        Start,
        text(
            "GAINS [GAINS ...]",
            "Gain files of the same compensator: each mechanism is tuned from the gains of the nearest "
            "of their mechanisms too.",
        ),
    ] = ()
    steps: Annotated[int, number("Most solver steps from each start."), Count] = 25
    validation: Annotated[int, number("Fresh scenarios to judge on."), Count] = 511
    objective: Annotated[
        ObjectiveOption,
        arg(metavar="NAME", help="Of the errors e - e*: rms, cvar (mean of the worst 5 percent) or worst."),
    ] = "rms"
    divergence_weight: Annotated[
        float, number("How much more a squared divergence (e > e*) counts than a squared convergence.")
    ] = 1.0
    command_weight: Annotated[
        Weight,
        text(
            "NUMBER",
            "How many times the limit a command is worth that peaks one ideal peak too high; by default 0.3 "
            "for impulse_ledger, 0 for others.",
        ),
    ] = None
    noise_weight: Annotated[
        Weight,
        text(
            "NUMBER",
            "How many times the limit it is worth to amplify sensor noise once more. Where sensors are noisy "
            "and no weight is given: the quietest gains within the limit; 0: the least error.",
        ),
    ] = None
    chatter_weight: Annotated[
        Weight,
        text(
            "NUMBER",
            "How many times the limit a command is worth that swings once too often by the ideal peak force.",
        ),
    ] = None
    transparency_weight: Annotated[
        Weight,
        text(
            "NUMBER",
            "How much errors of the same scenarios count with a push on the hardware, and damped; by "
            "default 1 for impulse_ledger, 0 for others.",
            aliases=("--honesty-weight",),
        ),
    ] = None
    pareto: Annotated[int, number("Points of a trade-off of restitution error, each a gain file.")] = 0
    pareto_against: Annotated[
        str | None,
        text(
            "NAME",
            "What --pareto trades the error against: noise, peak (of the command) or honesty; by "
            "default noise, or peak for impulse_ledger.",
        ),
    ] = None
    global_search: Annotated[
        bool,
        arg(
            name="global-search",
            aliases=("--certify",),
            metavar="",
            help="Also search all gains' whole ranges, with 50 times the evaluations: is there better?",
        ),
    ] = False
    seed: Annotated[int, number("Seed of scenarios and starts."), Seed] = 0
    limit: Limit = 0.01
    scheduler: Scheduler = None

    def check(self) -> None:
        """Check what can be checked without JAX. Raises `InputError`."""
        check_options(self)
        arguments.fits(self.compensator, None)
        if callable(self.objective) and self.pareto:
            raise ArgumentError("objective", "a function beside pareto", "one of rms, cvar, worst")
        tune_pareto.check(self.pareto, self.pareto_against, self.compensator)

    def fits(self, mechanism: AnyMechanism) -> None:
        """The mechanism has the axes for what is asked for. Raises `InputError`."""
        arguments.fits(self.compensator, mechanism)
        asked = ("setting", "start", "noise_weight", "chatter_weight", "transparency_weight", "pareto")
        arguments.not_in_six_axes(mechanism, **{name: getattr(self, name) for name in asked})
        if callable(self.objective):
            arguments.not_in_six_axes(mechanism, objective=self.objective)

    def settings(self) -> "TuneSettings":
        """The same as tuning takes it. Raises `InputError`; imports jax."""
        from tuning.gains.settings import TuneSettings

        arguments.setting(self.compensator, self.setting)
        return TuneSettings(
            self.scenarios,
            self.starts,
            self.steps,
            self.validation,
            self.seed,
            self._objective(),
            global_search=self.global_search,
            setting=self.setting,
            quiet=self.wants_quiet,
            judge_transparency=self.pareto_against == "honesty",
        )

    @property
    def wants_quiet(self) -> bool:
        """Tell whether there is a limit, and nothing but what is minimised by default is asked for."""
        weights = self.command_weight, self.noise_weight, self.chatter_weight, self.transparency_weight
        usual = self.objective == "rms" and self.divergence_weight == 1 and weights == (None,) * 4
        return usual and 0 < self.limit < math.inf

    def _objective(self) -> "Objective":
        """What is asked for and, where nothing is, what the compensator's kind calls for."""
        from tuning.gains.objective import WEIGHTS, Objective
        from tuning.transparency.probes import default_weights

        # Where no error is too large, or any is, the usual limit is the unit of the weights.
        limit = float(self.limit) if 0 < self.limit < math.inf else TuneOptions.limit
        given = {name: getattr(self, name) for name in WEIGHTS}
        stated = {name: weight for name, weight in given.items() if weight is not None}
        if not callable(self.objective):
            weights = {**default_weights(self.compensator), **stated}
            return Objective(self.objective, **weights, limit=limit)
        from tuning.gains.metrics_function import MetricsFunction

        # What the user wants small is all that he says it is.
        return Objective(**stated, function=MetricsFunction(self.objective), limit=limit)

    def known(self) -> "list[Tuned]":
        """What the gain files to start from hold. Raises `InputError`; imports jax."""
        from tuning.gains.transfer import Tuned

        start: Any = self.start
        alone = isinstance(start, (str, os.PathLike)) or hasattr(start, "document")
        given: Any = [start] if alone else start
        found = []
        for one in given:
            loaded = arguments.gain_file(one, "start")
            label = str(one) if isinstance(one, (str, os.PathLike)) else loaded.mechanism.name
            if loaded.compensator != self.compensator:
                allowed = f"gains of {self.compensator}"
                raise ArgumentError("start", f"gains of {loaded.compensator}", allowed, one_line(label))
            found.append(Tuned(loaded.mechanism, loaded.gains, label))
        return found
