"""Options of `tuning.tune` and `jaxhil tune`."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import structs
from tyro.conf import arg

from jaxhil.errors import to_one_line
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import MAX_LATENCY
from tuning.api import arguments, tune_pareto
from tuning.api.arguments import ArgumentError
from tuning.api.options import (
    AllowedValues,
    OptionalLimit,
    Scheduler,
    SeedRange,
    Setting,
    check_options,
    number_option,
    text_option,
)

if TYPE_CHECKING:
    from tuning.gains.objective import Objective
    from tuning.gains.settings import TuneSettings
    from tuning.gains.transfer import EarlierGains

    # On the command line, a value is a text. The function `tune` also accepts a result of `tune` as a start,
    # and a function as the objective.
    Start = Any
    ObjectiveOption = str | Callable[[Any], Any]
else:
    Start = tuple[str, ...]
    ObjectiveOption = str

CountRange = AllowedValues(1)
OptionalWeight = float | None


@dataclass(frozen=True, kw_only=True)
class TuneOptions:
    """Options of `tune`."""

    compensator: Annotated[str, arg(metavar="NAME", help="Compensator to tune.")] = "response_error"
    setting: Setting = None
    scenarios: Annotated[
        int | None,
        text_option("NUMBER", "Scenarios to tune on; by default 32, or 128 if sensors are noisy."),
        CountRange,
    ] = None
    starts: Annotated[
        int,
        number_option(
            "Number of starts of the solver, and of starts added each time if results disagree; without "
            "effect for impulse_ledger with one axis."
        ),
        CountRange,
    ] = 4
    start: Annotated[
        Start,
        text_option(
            "GAINS [GAINS ...]",
            "Gain files of the same compensator. The tuning of a mechanism also starts from the gains of the "
            "file whose mechanism is most similar.",
        ),
    ] = ()
    steps: Annotated[
        int,
        number_option(
            "Largest number of solver steps from each start; for impulse_ledger with one axis, number of "
            "generations of the search."
        ),
        CountRange,
    ] = 25
    validation: Annotated[
        int, number_option("Fresh scenarios for the evaluation.", name="evaluated"), CountRange
    ] = 511
    objective: Annotated[
        ObjectiveOption,
        arg(
            metavar="NAME",
            help="Statistic of the errors e - e*: rms, cvar (mean of the worst 5 percent) or worst.",
        ),
    ] = "rms"
    divergence_weight: Annotated[
        float,
        number_option("Weight of the squared error of a divergence (e > e*); that of a convergence is 1."),
    ] = 1.0
    command_weight: Annotated[
        OptionalWeight,
        text_option(
            "NUMBER",
            "Penalty, in multiples of the limit, for a peak command of twice the ideal peak force; by "
            "default 0.3 for impulse_ledger, 0 for others.",
        ),
    ] = None
    noise_weight: Annotated[
        OptionalWeight,
        text_option(
            "NUMBER",
            "Penalty, in multiples of the limit, for an increase of the noise amplification by 1. By default "
            "with noisy sensors, the quietest gains within the limit are chosen; 0 chooses the least error.",
        ),
    ] = None
    chatter_weight: Annotated[
        OptionalWeight,
        text_option(
            "NUMBER",
            "Penalty, in multiples of the limit, for an additional swing of the command as large as the "
            "ideal peak force.",
        ),
    ] = None
    transparency_weight: Annotated[
        OptionalWeight,
        text_option(
            "NUMBER",
            "Weight of the errors in runs of the same scenarios with a push on the hardware or more damping; "
            "by default 1 for impulse_ledger, 0 for others.",
        ),
    ] = None
    pareto: Annotated[
        int,
        number_option("Number of points of a Pareto front of the restitution error, each with a gain file."),
    ] = 0
    pareto_against: Annotated[
        str | None,
        text_option(
            "NAME",
            "Cost that --pareto trades off against the error: noise, peak (of the command) or transparency; "
            "by default noise, or peak for impulse_ledger.",
        ),
    ] = None
    global_search: Annotated[
        bool,
        arg(
            name="global-search",
            metavar="",
            help="Also search the full range of all gains for better gains, with 50 times the evaluations.",
        ),
    ] = False
    extra_periods: Annotated[
        int,
        number_option("Periods that a co-simulation with FMUs adds to rig.command_latency."),
        AllowedValues(0, MAX_LATENCY),
    ] = 0
    seed: Annotated[int, number_option("Seed of scenarios and starts."), SeedRange] = 0
    limit: OptionalLimit = None
    scheduler: Scheduler = None

    def check(self) -> None:
        """Raise `InputError` if a value or a combination of options is not allowed.

        Values whose check needs jax are not checked here.
        """
        check_options(self)
        arguments.check_supports_mechanism(self.compensator, None)
        if callable(self.objective) and self.pareto:
            raise ArgumentError("objective", "a function together with pareto", "rms, cvar or worst")
        tune_pareto.check_pareto_options(self.pareto, self.pareto_against, self.compensator)

    def check_mechanism(self, mechanism: AnyMechanism) -> None:
        """Raise `InputError` if an option does not support the number of axes of the mechanism."""
        arguments.check_supports_mechanism(self.compensator, mechanism)
        options = ("setting", "start", "noise_weight", "chatter_weight", "transparency_weight")
        arguments.check_one_axis_arguments(mechanism, **{name: getattr(self, name) for name in options})
        if self.pareto and isinstance(mechanism, SixAxisMechanism):
            tune_pareto.check_six_axis_cost(self.pareto_against)
        if callable(self.objective):
            arguments.check_one_axis_arguments(mechanism, objective=self.objective)

    def add_extra_periods(self, mechanism: AnyMechanism) -> AnyMechanism:
        """Return the mechanism with `extra_periods` added to its command latency."""
        latency, rig = mechanism.rig.command_latency + self.extra_periods, mechanism.rig
        if latency > MAX_LATENCY:
            most = MAX_LATENCY - rig.command_latency
            allowed = f"at most {most}: rig.command_latency is at most {MAX_LATENCY}"
            raise ArgumentError("extra_periods", str(self.extra_periods), allowed, mechanism.name)
        return structs.replace(mechanism, rig=structs.replace(rig, command_latency=latency))

    def settings(self, axes: int = 1) -> "TuneSettings":
        """Build the settings of the tuning for 1 or 6 axes; raise `InputError` if an option is invalid."""
        from tuning.gains.settings import TuneSettings

        arguments.check_setting_name(self.compensator, self.setting)
        return TuneSettings(
            self.scenarios,
            self.starts,
            self.steps,
            self.validation,
            self.seed,
            self._objective(axes),
            global_search=self.global_search,
            setting=self.setting,
            quiet=self.wants_quiet,
            bounded=self._has_default_objective,
            evaluate_transparency=self.pareto_against == "transparency",
        )

    @property
    def wants_quiet(self) -> bool:
        """Return whether the options ask for quiet gains.

        Quiet gains have an error within the limit. Among all such gains, they amplify sensor noise least and
        cause the smallest peaks of the force command. The options ask for quiet gains if the limit is
        positive and finite, and all options of the objective have their default values.
        """
        return self._has_default_objective and self._has_finite_limit

    @property
    def _has_default_objective(self) -> bool:
        weights = self.command_weight, self.noise_weight, self.chatter_weight, self.transparency_weight
        return self.objective == "rms" and self.divergence_weight == 1 and weights == (None,) * 4

    @property
    def _has_finite_limit(self) -> bool:
        return self.limit is None or 0 < self.limit < math.inf

    def _objective(self, axes: int) -> "Objective":
        """Return the objective; an unspecified weight has the compensator's default value."""
        from tuning.gains.objective import WEIGHT_FIELDS, Objective
        from tuning.transparency.probes import choose_default_weights

        # If the limit is 0 or infinite, the default limit is the unit of the weights.
        default = arguments.DEFAULT_LIMIT if axes == 1 else arguments.SIX_AXIS_DEFAULT_LIMIT
        limit = default if self.limit is None or not self._has_finite_limit else float(self.limit)
        options = {name: getattr(self, name) for name in WEIGHT_FIELDS}
        user_weights = {name: weight for name, weight in options.items() if weight is not None}
        if not callable(self.objective):
            weights = {**choose_default_weights(self.compensator, axes), **user_weights}
            return Objective(self.objective, **weights, limit=limit)
        from tuning.gains.metrics_function import MetricsFunction

        # A user's function is minimised without default weights.
        return Objective(**user_weights, function=MetricsFunction(self.objective), limit=limit)

    def load_start_gains(self) -> "list[EarlierGains]":
        """Return the earlier tuned gains that the option `start` names.

        Raise `InputError` if they cannot be read or belong to another compensator. This method imports jax.
        """
        from tuning.gains.transfer import EarlierGains

        start: Any = self.start
        is_single = isinstance(start, (str, os.PathLike)) or hasattr(start, "document")
        sources: Any = [start] if is_single else start
        start_gains = []
        for source in sources:
            loaded = arguments.load_gains(source, "start")
            label = str(source) if isinstance(source, (str, os.PathLike)) else loaded.mechanism.name
            if loaded.compensator != self.compensator:
                allowed = f"gains of {self.compensator}"
                raise ArgumentError("start", f"gains of {loaded.compensator}", allowed, to_one_line(label))
            start_gains.append(EarlierGains(loaded.mechanism, loaded.gains, label))
        return start_gains
