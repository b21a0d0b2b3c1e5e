"""Function `tuning.tune`, which tunes one compensator's gains for one or several mechanisms."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from jaxhil.mechanism.file import LoadedAnyMechanism, LoadedMechanism
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments, mechanism_summary, tune_pareto
from tuning.api.options import add_options
from tuning.api.tune_duration import describe_expected_duration, record_duration
from tuning.api.tune_options import TuneOptions
from tuning.api.tuned_gains import TunedGains

if TYPE_CHECKING:
    from tuning.caches.checkpoints import Checkpoints


@arguments.convert_os_errors
@add_options(TuneOptions)
def tune(
    mechanism: Any,
    compensator: str = TuneOptions.compensator,
    *,
    progress: bool = False,
    **options: Any,
) -> Any:
    """Tune a compensator's gains for a mechanism, and evaluate the tuned gains on fresh scenarios.

    Equal arguments give equal gains to the last bit. The command `jaxhil tune` gives the same gains.

    Args:
        mechanism: result of `jaxhil.load`, or a name or path that `jaxhil.load` accepts; or a list of these,
            whose mechanisms are tuned together.
        compensator: name of a built-in or registered compensator that supports the mechanism's axes.
        progress: report the progress on standard error.
        **options: see `TuneOptions`.

    The option `start` also accepts results of `tune`. The option `objective` also accepts a function to
    minimise, which gets the metrics of all scenarios and returns a number >= 0.

    Returns:
        A `TunedGains` with gains, errors and verdict; for a list of mechanisms, a list of `TunedGains`.

    Raises:
        InputError: If an argument is unusable; the message has one line.

    Example:
        >>> import tuning
        >>> tuned = tuning.tune("rig-300kg", "phase_lead", scenarios=4, starts=1, validation=4)
        >>> sorted(tuned.gains)
        ['lead_filter', 'phase_lead']
        >>> tuned.verdict
        'bad'
    """
    settings = TuneOptions(compensator=compensator, **options)
    arguments.check_booleans(progress=progress)
    loaded, is_list = arguments.load_any_mechanisms(mechanism)
    settings.check()
    for entry in loaded:
        settings.check_mechanism(entry.mechanism)
    with jax_context():
        for entry in loaded:
            mechanism_summary.check_can_be_simulated(entry.mechanism, entry.label)
        for entry in loaded if progress else ():
            mechanism_summary.report_summary(entry.mechanism, terminal.note)
    with jax_context(), terminal.show_progress(len(loaded), "mechanisms", progress) as bar:
        by_index = dict(tune_each(loaded, settings, bar))
        results = [by_index[index] for index in range(len(loaded))]
    if settings.pareto:
        with jax_context(), terminal.show_progress(len(loaded), "fronts", progress) as bar:
            for index, front in tune_pareto.compute_fronts(
                results, settings.pareto, settings.pareto_against, bar, None, settings.scheduler
            ):
                results[index] = dataclasses.replace(results[index], pareto=tuple(front))
    return results if is_list else results[0]


def tune_each(
    loaded: Sequence[LoadedMechanism | LoadedAnyMechanism],
    options: TuneOptions,
    bar: terminal.Progress,
    checkpoints: "Checkpoints | None" = None,
    announce: Callable[[str], None] | None = None,
) -> Iterator[tuple[int, TunedGains]]:
    """Tune several mechanisms, and yield the index and the result of each as soon as it is finished.

    Args:
        loaded: mechanisms.
        options: options of the tuning.
        bar: progress display.
        checkpoints: results of finished work, which is not repeated; new results are added.
        announce: is called before the search with a text on the time that it will take, unless it is None.

    Yields:
        Index into `loaded`, and tuned gains.
    """
    from jaxhil.laws.compensators import axes_of
    from tuning.caches.checkpoints import NO_CHECKPOINTS
    from tuning.gains.search_progress import SearchProgress
    from tuning.gains.tune_all import tune_all

    mechanisms = [options.add_extra_periods(entry.mechanism) for entry in loaded]
    settings, earlier = options.settings(max(map(axes_of, mechanisms))), options.load_start_gains()
    number = len(loaded)
    work = SearchProgress(lambda text, share, before: bar.tell(text, share * number, before * number))
    if announce is not None:
        work.announce = lambda runs: announce(
            describe_expected_duration(mechanisms, options.compensator, runs)
        )
    seconds, begun = 0.0, time.monotonic()
    results = tune_all(
        mechanisms,
        options.compensator,
        settings,
        work,
        earlier,
        checkpoints=checkpoints or NO_CHECKPOINTS,
        scheduler=options.scheduler,
    )
    for index, result in results:
        seconds += time.monotonic() - begun  # without the time that the caller spends on a result
        yield (
            index,
            TunedGains(
                result,
                loaded[index].sha256,
                arguments.choose_limit(options.limit, result.mechanism),
                extra_periods=options.extra_periods,
            ),
        )
        begun = time.monotonic()
    if options.scheduler is None:
        record_duration(mechanisms, options.compensator, work.computed_runs, seconds)
