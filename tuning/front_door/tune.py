"""`tuning.tune`: the gains of one compensator for one mechanism or several, judged on fresh scenarios."""

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxhil.errors import one_line
from jaxhil.mechanism.file import AnyMechanism, LoadedAny, LoadedMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments, meaning, tune_pareto, tune_verdict
from tuning.front_door.arguments import ArgumentError
from tuning.front_door.tune_pareto import TradedGains
from tuning.front_door.tune_verdict import CommandFigures

if TYPE_CHECKING:
    from jaxhil.simulation.plausibility import Meaning
    from tuning.caches.pieces import Pieces
    from tuning.gains.objective import Objective
    from tuning.gains.settings import TuneSettings
    from tuning.gains.transfer import Tuned
    from tuning.gains.tune import ErrorFigures, TuneResult


@dataclass(frozen=True)
class TuneOptions:
    """What `tune` is to do; `tune` says what each means."""

    compensator: str = "response_error"
    setting: str | None = None
    scenarios: int | None = None
    starts: int = 4
    start: Sequence[Any] = ()
    steps: int = 25
    validation: int = 511
    objective: str | Callable[[Any], Any] = "rms"
    divergence_weight: float = 1.0
    command_weight: float | None = None
    noise_weight: float | None = None
    chatter_weight: float | None = None
    transparency_weight: float | None = None
    global_search: bool = False
    seed: int = 0
    limit: float = 0.01
    pareto: int = 0
    pareto_against: str | None = None
    scheduler: str | None = None

    def check(self) -> None:
        """What can be checked without jax. Raises `InputError`."""
        arguments.limit(self.limit)
        arguments.integers(1, starts=self.starts, steps=self.steps, validation=self.validation)
        if self.scenarios is not None:
            arguments.integers(1, scenarios=self.scenarios)
        arguments.integers(0, seed=self.seed)
        arguments.fits(self.compensator, None)
        arguments.flags(global_search=self.global_search)
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
        """Whether there is a limit, and nothing else is asked to be minimised than what is by default."""
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

        given = [self.start] if isinstance(self.start, (str, os.PathLike, TunedGains)) else self.start
        found = []
        for one in given:
            loaded = arguments.gain_file(one, "start")
            label = str(one) if isinstance(one, (str, os.PathLike)) else loaded.mechanism.name
            if loaded.compensator != self.compensator:
                allowed = f"gains of {self.compensator}"
                raise ArgumentError("start", f"gains of {loaded.compensator}", allowed, one_line(label))
            found.append(Tuned(loaded.mechanism, loaded.gains, label))
        return found


@dataclass(frozen=True)
class TunedGains:
    """What `tune` returns of one mechanism.

    found: all that tuning found (`tuning.gains.tune.TuneResult`).
    mechanism_sha256: SHA-256 of the mechanism's file.
    limit: the rms error [1] that is still good.
    pareto: the front of gains that trade the error for something else, if one was asked for.
    """

    found: "TuneResult"
    mechanism_sha256: str
    limit: float
    pareto: tuple[TradedGains, ...] = ()

    @property
    def mechanism(self) -> AnyMechanism:
        """What was tuned for."""
        return self.found.mechanism

    @property
    def compensator(self) -> str:
        """The name of the law that was tuned."""
        return self.found.compensator

    @property
    def gains(self) -> dict[str, float]:
        """The tuned gains by name [SI units], those that are not tuned among them."""
        return self.found.gains

    @property
    def literature(self) -> dict[str, float]:
        """The gains that the literature's rules give, or those of the setting, by name [SI units]."""
        return self.found.literature

    @property
    def figures(self) -> "dict[str, ErrorFigures]":
        """Errors on fresh scenarios "before" (no compensation), with the "literature"'s gains and with the
        "tuned" ones: each has rms, p99, max [1] and more."""
        return self.found.figures

    @property
    def parts(self) -> "dict[str, dict[str, ErrorFigures]]":
        """In six axes, the same of "energy_error" and "twist_error", each by itself; else nothing."""
        from tuning.gains.tune import figures_of_parts

        return figures_of_parts(self.found)

    @property
    def verdict(self) -> str:
        """ "good" if every contact ended with the tuned gains, their rms error is within the limit, and at
        most 1 % of the real contacts are harder, shorter or longer than the ideal contact allows, with the
        sensors' noise and without, else "bad"."""
        return "good" if tune_verdict.is_good(self.found, self.limit) else "bad"

    @property
    def without_noise(self) -> "ErrorFigures | None":
        """Errors of the tuned gains on the same scenarios without the sensors' noise; None where the
        mechanism has none."""
        return self.found.without_noise

    @functools.cached_property
    def command(self) -> CommandFigures:
        """What the tuned gains do to the force command: `peak_p99`, the 99th percentile of its peak over the
        ideal contact's peak force, and `noise_amplification` [1]."""
        return tune_verdict.command_figures(self.found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each figure of `command` beyond its bound."""
        return tune_verdict.command_warnings(self.found, self.command)

    @functools.cached_property
    def meaning(self) -> "Meaning | None":
        """What the mechanism means: mass, contacts in space, rates; `warnings` of what cannot be meant. In
        six axes None: a run of `jaxhil.simulate` has it."""
        from jaxhil.simulation import plausibility

        if isinstance(self.mechanism, SixAxisMechanism):
            return None
        return plausibility.meaning(self.mechanism)

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """The content of the gain file."""
        from tuning.gain_file import build_document, envelope_in_space, validity_envelope
        from tuning.transparency.pushes import PUSHES

        found = self.found
        if isinstance(found.mechanism, SixAxisMechanism):
            envelope = envelope_in_space(found.scenarios, found.outcomes["tuned"])
        else:
            envelope = validity_envelope(found.mechanism, found.scenarios)
        return build_document(
            found.compensator,
            found.gains,
            found.mechanism,
            self.mechanism_sha256,
            envelope,
            {
                "nominal": found.nominal,
                "robust": found.figures,
                "tuned_intervals": found.intervals.plain() if found.intervals else None,
                **self.parts,
                "without_noise": found.without_noise,
                "command": self.command,
                "warnings": self.warnings,
                **({"honesty": found.transparency, "transparency": PUSHES} if found.transparency else {}),
            },
            found.settings.seed,
            found.timings,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file. Raises `InputError` when it cannot be written."""
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.folder("path", path), self.document)


# Longer than a screen for its arguments alone, each stated with its meaning.
@arguments.entry
def tune(
    mechanism: Any,
    compensator: str = "response_error",
    *,
    setting: str | None = None,
    scenarios: int | None = None,
    starts: int = 4,
    start: Any = (),
    steps: int = 25,
    validation: int = 511,
    objective: str | Callable[[Any], Any] = "rms",
    divergence_weight: float = 1.0,
    command_weight: float | None = None,
    noise_weight: float | None = None,
    chatter_weight: float | None = None,
    transparency_weight: float | None = None,
    global_search: bool = False,
    pareto: int = 0,
    pareto_against: str | None = None,
    seed: int = 0,
    limit: float = 0.01,
    scheduler: str | None = None,
    progress: bool = False,
) -> Any:
    """Tune a compensator's gains for a mechanism; judge them on scenarios that tuning never saw.

    Equal arguments give equal gains to the bit, and those of `jaxhil tune`.

    Args:
        mechanism: what `jaxhil.load` returns, or a name or path for it; or a list of those, which are tuned
            together.
        compensator: name of a law, built in or registered; in six axes "none", "phase_lead" or
            "phase_lead_per_axis".
        setting: take the law's gains of that name as they are, and only judge them.
        scenarios: how many to tune on; by default 32, or 128 where sensors are noisy.
        starts: of the solver, and of each further batch of starts where they disagree.
        start: gain files, or results of `tune`, of the same compensator: each mechanism is tuned from the
            gains of the nearest of their mechanisms too.
        steps: most solver steps from each start.
        validation: how many fresh scenarios to judge on.
        objective: of the errors e - e*: "rms", "cvar" (mean of the worst 5 percent) or "worst"; or a
            function of the metrics of all scenarios, which returns a number >= 0 to be made small.
        divergence_weight: how much more a squared divergence counts than a squared convergence.
        command_weight: how many times the limit a command is worth that peaks one ideal peak too high; None:
            what the law calls for.
        noise_weight: the same of an amplification of sensor noise one too large. Where sensors are noisy, and
            neither a weight nor another objective is given, the quietest gains whose error is within the
            limit are sought, and those of least error if there are none; 0: those of least error.
        chatter_weight: the same of a command that swings once too often by the ideal peak force.
        transparency_weight: of the errors of pushed and damped scenarios; None: what the law calls for.
        global_search: also search all gains' whole ranges, with 50 times the evaluations.
        pareto: also so many gains that trade the error for something else.
        pareto_against: for what: "noise", "peak" (of the command) or "honesty"; by default "noise", or "peak"
            where the law anticipates.
        seed: of scenarios and starts.
        limit: the rms error [1] that is still good, and the unit of the three weights.
        scheduler: address of a dask.distributed cluster's scheduler, whose workers then tune.
        progress: say on standard error what is going on.

    Returns:
        A `TunedGains`; a list of them for a list.

    Raises:
        InputError: one line, for an argument that will not do.
    """
    given = {name: value for name, value in locals().items() if name not in ("mechanism", "progress")}
    options = TuneOptions(**given)
    arguments.flags(progress=progress)
    loaded, several = arguments.any_mechanisms(mechanism)
    options.check()
    for one in loaded:
        options.fits(one.mechanism)
    with computing():
        for one in loaded:
            meaning.check(one.mechanism, one.label)
        for one in loaded if progress else ():
            meaning.say(one.mechanism, terminal.note)
    with computing(), terminal.progress(len(loaded), "mechanisms", progress) as bar:
        found = dict(tune_each(loaded, options, bar))
        results = [found[index] for index in range(len(loaded))]
    if pareto:
        with computing(), terminal.progress(len(loaded), "fronts", progress) as bar:
            for place, front in tune_pareto.trade(results, pareto, pareto_against, bar, None, scheduler):
                results[place] = dataclasses.replace(results[place], pareto=tuple(front))
    return results if several else results[0]


def tune_each(
    loaded: Sequence[LoadedMechanism | LoadedAny],
    options: TuneOptions,
    bar: terminal.Progress,
    pieces: "Pieces | None" = None,
) -> Iterator[tuple[int, TunedGains]]:
    """Index and result of every mechanism, as they are done; the `bar` shows how far it is. What is among the
    `pieces` is taken from there, and the rest kept there."""
    from tuning.caches.pieces import NOTHING_KEPT
    from tuning.gains.tune_all import tune_all
    from tuning.gains.work import Work

    settings, known = options.settings(), options.known()
    mechanisms = [one.mechanism for one in loaded]
    number = len(loaded)
    work = Work(lambda text, share, before: bar.tell(text, share * number, before * number))
    kept = pieces or NOTHING_KEPT
    results = tune_all(
        mechanisms, options.compensator, settings, work, known, pieces=kept, scheduler=options.scheduler
    )
    for index, found in results:
        yield index, TunedGains(found, loaded[index].sha256, options.limit)
