"""`tuning.tune`: the gains of one compensator for one mechanism or several, judged on fresh scenarios."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from jaxhil.mechanism.file import LoadedAny, LoadedMechanism
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments, meaning, tune_pareto
from tuning.front_door.options import takes
from tuning.front_door.tune_options import TuneOptions
from tuning.front_door.tuned_gains import TunedGains

if TYPE_CHECKING:
    from tuning.caches.pieces import Pieces


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
