"""`tuning.tune`: the gains of one compensator for one mechanism or several, judged on fresh scenarios."""

import dataclasses
import functools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxhil.mechanism.file import AnyMechanism, LoadedAny, LoadedMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments, meaning, tune_pareto, tune_verdict
from tuning.front_door.options import takes
from tuning.front_door.tune_options import TuneOptions
from tuning.front_door.tune_pareto import TradedGains
from tuning.front_door.tune_verdict import CommandFigures

if TYPE_CHECKING:
    from jaxhil.simulation.plausibility import Meaning
    from tuning.caches.pieces import Pieces
    from tuning.gains.tune import ErrorFigures, TuneResult


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


@arguments.entry
@takes(TuneOptions)
def tune(
    mechanism: Any,
    compensator: str = TuneOptions.compensator,
    *,
    progress: bool = False,
    **options: Any,
) -> Any:
    """Tune a compensator's gains for a mechanism; judge them on scenarios that tuning never saw.

    Equal arguments give equal gains to the bit, and those of `jaxhil tune`.

    Args:
        mechanism: what `jaxhil.load` returns, or a name or path for it; or a list of those, which are tuned
            together.
        compensator: name of a law, built in or registered; in six axes "none", "phase_lead" or
            "phase_lead_per_axis".
        progress: say on standard error what is going on.
    OPTIONS

    `start` also takes results of `tune`, and `objective` a function of the metrics of all scenarios, which
    returns a number >= 0 to be made small.

    Returns:
        A `TunedGains`; a list of them for a list.

    Raises:
        InputError: one line, for an argument that will not do.
    """
    asked = TuneOptions(compensator=compensator, **options)
    arguments.flags(progress=progress)
    loaded, several = arguments.any_mechanisms(mechanism)
    asked.check()
    for one in loaded:
        asked.fits(one.mechanism)
    with computing():
        for one in loaded:
            meaning.check(one.mechanism, one.label)
        for one in loaded if progress else ():
            meaning.say(one.mechanism, terminal.note)
    with computing(), terminal.progress(len(loaded), "mechanisms", progress) as bar:
        found = dict(tune_each(loaded, asked, bar))
        results = [found[index] for index in range(len(loaded))]
    if asked.pareto:
        with computing(), terminal.progress(len(loaded), "fronts", progress) as bar:
            for place, front in tune_pareto.trade(
                results, asked.pareto, asked.pareto_against, bar, None, asked.scheduler
            ):
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
