"""Sections of a report on simulations: runs, errors, sensitivities, comparison, stability map, commands."""

import shlex
from collections.abc import Callable, Iterator, Mapping

from jaxhil.errors import to_one_line
from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS_TEXT
from tuning.number_format import format_number
from tuning.reporting.documents import MarginOfMap, MetricEntry
from tuning.reporting.drawings import TYPICAL_SCENARIOS, draw_map, draw_nominal_run, draw_sweep
from tuning.reporting.result_files import Results
from tuning.reporting.verdict_sections import ReportTable, Section

METRIC_HEADINGS = {  # headings of the comparison's table by name of the metric
    "rms": "rms |e - e*|", "p99": "99th percentile", "worst": "worst", "failures": "failures",
    "early": "early", "late": "late", "slope": "slope", "peak": "peak", "noise": "noise",
}  # fmt: skip
SIX_AXIS_METRIC_HEADINGS = {  # headings for six axes by name of the metric
    "energy_rms": "rms energy error",
    "rms": "rms twist error",
    "p99": "99th pct of twist error",
    "failures": "failures",
    "peak": "peak ratio",
    "not_ended": "not ended",
}
TRANSPARENCY_NOTE = (
    "Early, late: transparency, that is, effect on e of a push on the hardware at 25 or 75 % of the ideal "
    "contact's duration, divided by the effect on the ideal contact (1: perfect, 0: none). Slope: slope of e "
    "against e* for damping perturbations (1: perfect). Peak: peak command divided by the ideal contact's "
    "peak force. Noise: noise of the command divided by the noise of the readings."
)


def count_plots(results: Results) -> int:
    """Return an upper bound of the number of plots in the report, for the progress display."""
    scenarios = (
        0 if results.sweep is None or results.axes == 6 else len(results.sweep.worst) + TYPICAL_SCENARIOS + 1
    )
    return (results.subject is not None) + scenarios + (results.map is not None)


def run_sections(results: Results, say: Callable[[str], None]) -> tuple[Section | None, Section | None]:
    """Return two sections of the report: one contact in short, and simulated runs.

    The runs are the nominal run and scenarios of the sweep. A section without data is None.
    """
    if results.subject is None:
        return None, None
    say("the nominal run")
    contact, run = draw_nominal_run(results.subject)
    summary = None
    if contact is not None:
        summary = Section(
            "summary", "In short", list(_describe_results(results, contact.says)), (), [contact]
        )
    drawings, traces, texts = [run], [], []
    if results.axes == 6:
        return summary, Section("runs", "The nominal run", texts, [], drawings, traces)
    if results.store is not None and results.sweep is not None:
        say("scenarios of the sweep")
        points, traces = draw_sweep(results.store, results.sweep.worst, say)
        drawings.append(points)
        texts.append(
            "Scenarios of the sweep: the worst ones, and some between the smallest and the largest error."
        )
    title = "The nominal run" + (" and the worst scenarios" if traces else "")
    return summary, Section("runs", title, texts, [], drawings, traces)


def _describe_results(results: Results, contact: str) -> Iterator[str]:
    """Yield sentences that explain one contact and the sweep's failures to readers without the theory."""
    yield contact
    yield (
        "e, the restitution, is the rebound speed divided by the approach speed. Delays of the rig change e; "
        "the compensator must restore the ideal contact's e."
    )
    if (sweep := results.sweep) is not None:
        share = 100 * sweep.failure_probability.value
        limit = "" if sweep.limit is None else f": an error of e above {sweep.limit:g}, or a contact that"
        limit += " does not end well" if limit else ""
        yield f"Of {sweep.scenarios} random scenarios, {sweep.failed} ({share:.2g} %) fail{limit}."


def error_section(results: Results) -> Section | None:
    """Return the report's section on the errors and outcomes of a sweep, or None without a sweep."""
    sweep = results.sweep
    if sweep is None:
        return None
    rows = [
        (
            f"{100 * quantile.order:g} %",
            format_number(quantile.value),
            f"{format_number(quantile.low)} to {format_number(quantile.high)}",
        )
        for quantile in sweep.error_quantiles
    ]
    tables = [ReportTable(("share of scenarios", f"worst {results.error} up to", "95 %"), rows)]
    ended = [
        (outcome, str(count), f"{count / max(sweep.scenarios, 1):.4g}")
        for outcome, count in sweep.outcomes.items()
    ]
    tables.append(ReportTable(("outcome", "scenarios", "share"), ended))
    origin = f"{sweep.scenarios} scenarios, {sweep.sampling}, seed {sweep.seed}, {sweep.precision}"
    method = to_one_line(sweep.failure_probability.method, 200)
    texts = [f"{origin}. Interval of the failure probability: {method}."]
    return Section("errors", "Distribution of the error", texts, tables)


def sensitivity_section(results: Results) -> Section | None:
    """Return the report's section on a sweep's Sobol indices and rare errors; None if it has neither."""
    sweep = results.sweep
    if sweep is None or (sweep.drivers is None and sweep.rare is None):
        return None
    tables, texts = [], []
    if (indices := sweep.drivers) is not None:
        rows = [
            (
                shares.input,
                format_number(shares.first_order, 3),
                f"{format_number(shares.first_order_low, 3)} to {format_number(shares.first_order_high, 3)}",
                format_number(shares.total, 3),
                f"{format_number(shares.total_low, 3)} to {format_number(shares.total_high, 3)}",
            )
            for shares in indices.inputs
        ]
        tables.append(ReportTable(("input", "first order", "95 %", "total", "95 %"), rows))
        texts.append(
            f"Sobol indices: shares of the variance of the worst {results.error}, clipped at {indices.cap:g} "
            f"({indices.capped} of {indices.evaluations} runs)."
        )
    if (rare := sweep.rare) is not None:
        interval = f"{format_number(rare.low, 3)} to {format_number(rare.high, 3)}"
        row = (format_number(rare.limit), format_number(rare.probability, 3), interval, str(rare.evaluations))
        tables.append(ReportTable((f"{results.error} beyond", "probability", "95 %", "scenarios"), [row], 0))
        if rare.spread_beyond_formula:
            texts.append(
                "The replicates of the subset simulation differ far more than its formula explains: some "
                "have missed failures, and the interval may be wrong."
            )
    return Section("drivers", "Sensitivity of the error, and rare errors", texts, tables)


def comparison_section(results: Results) -> Section | None:
    """Return the report's section on the comparison of compensators, or None without a comparison."""
    compared = results.comparison
    if compared is None:
        return None
    subject, tables, texts = results.subject, [], [] if compared.axes == 6 else [TRANSPARENCY_NOTE]
    headings = SIX_AXIS_METRIC_HEADINGS if compared.axes == 6 else METRIC_HEADINGS
    for entry in compared.mechanisms:
        if subject is not None and entry.mechanism != subject.mechanism.name:
            continue
        rows = [
            (f"{law.law}, {gains_name}", *(_format_metric(figures.get(key)) for key in headings))
            for law in entry.laws
            for gains_name, figures in law.figures.items()
        ]
        tables.append(ReportTable((entry.mechanism, *headings.values()), rows))
    texts.append(
        f"All compensators are evaluated on the same {compared.judged} fresh scenarios. Brackets contain "
        "95 % intervals."
    )
    title = "Other compensators" if compared.axes == 6 else "Transparency, and other compensators"
    return Section("comparison", title, texts, tables)


def map_section(results: Results, say: Callable[[str], None]) -> Section | None:
    """Return the report's section with the stability map and the margins, or None without a map."""
    document = results.map
    if document is None:
        return None
    say("the stability map")
    texts, rows = [], []
    if document.nominal.error is not None:
        texts.append(f"At the nominal point the largest error is {document.nominal.error:+.4f}.")
    if document.nominal.peak_force_ratio is not None:
        texts.append(
            f"There, the largest real peak force is {format_number(document.nominal.peak_force_ratio, 3)} "
            "times the ideal contact's, and the duration is "
            f"{format_number(document.nominal.duration_ratio, 3)} times the ideal contact's."
        )
    if (growth := document.nominal.growth) is not None:
        verb = "grows" if growth.per_second > 0 else "decays"
        texts.append(
            f"A contact that lasts {verb} by {abs(growth.per_second):.4g} per second "
            f"(spectral radius {growth.spectral_radius:.6f} a control period)."
        )
    margins = document.nominal.margins
    for condition, margin in (
        (f"{results.error} within {format_number(document.limit)}", margins.error),
        (CONTACT_BOUNDS_TEXT, margins.contact),
        ("spectral radius at most 1", margins.spectral_radius),
    ):
        for axis, key in (("x", document.x), ("y", document.y)):
            if margin is not None and axis in margin:
                rows.append(
                    (key.key, condition, format_number(key.nominal), _format_margin(margin[axis]), key.unit)
                )
    tables = [ReportTable(("key", "condition", "nominal", "holds", "unit"), rows, 9)] if rows else []
    return Section("map", "Stability map", texts, tables, [draw_map(document)])


def reproduction_section(results: Results) -> Section:
    """Return the report's section on reproduction: files with digests, software versions, commands."""
    sources = [
        (f"jaxhil {source.command}", to_one_line(str(source.path), 200), source.sha256)
        for source in results.sources
    ]
    tables = [ReportTable(("result of", "file", "SHA-256"), sources, 9)]
    for document in (results.identification, results.monitoring):
        if document is not None:
            logs = [(to_one_line(name, 200), sha256) for name, sha256 in document.sources.items()]
            tables.append(ReportTable(("log", "SHA-256"), logs, 9))
    if versions := _software_versions(results):
        tables.append(
            ReportTable(("package", "version that computed the results"), list(versions.items()), 9)
        )
    texts = ["Each of these commands, applied to the files above, computes its results again."]
    return Section(
        "reproduction", "How to reproduce the results", texts, tables, lines=list(_repeat_commands(results))
    )


def _repeat_commands(results: Results) -> Iterator[str]:
    """Yield the shell commands that compute the results again."""
    paths = {source.command: str(source.path) for source in results.sources}
    subject, sweep = results.subject, results.sweep
    gains = paths.get("tune", paths.get("export", "GAINS"))
    if ("tune" in paths or "export" in paths) and results.axes == 1:
        yield _format_command("verify", paths.get("export", gains))
    if sweep is not None:
        options = {"scenarios": sweep.scenarios, "seed": sweep.seed, "sampling": sweep.sampling,
                   "precision": sweep.precision, "limit": sweep.limit,
                   "acceptable": sweep.acceptable}  # fmt: skip
        studies = (["--drivers"] if sweep.drivers else []) + (["--rare"] if sweep.rare else [])
        yield _format_command("sweep", gains, "-o", "again", *_option_words(options), *studies)
        for scenario in sweep.worst[:1]:
            yield _format_command("replay", paths["sweep"], str(scenario.index), "--plot", "worst.png")
    name = subject.mechanism.name if subject is not None else "MECHANISM"
    if (compared := results.comparison) is not None:
        names = [entry.mechanism for entry in compared.mechanisms]
        options = {"scenarios": compared.scenarios, "evaluated": compared.judged, "seed": compared.seed,
                   "limit": compared.limit}  # fmt: skip
        laws = list(dict.fromkeys(law.law for entry in compared.mechanisms for law in entry.laws))
        untuned = [] if compared.tuned else ["--untuned"]
        yield _format_command("compare", *names, *_option_words(options), *untuned, "--compensators", *laws)
    if (stability_map := results.map) is not None:
        axes = [
            f"{axis.key}={axis.values[0]!r}:{axis.values[-1]!r}"
            for axis in (stability_map.x, stability_map.y)
        ]
        gain_words = ["--gains", gains] if stability_map.gains and subject is not None else []
        options = {
            "limit": stability_map.limit,
            "seed": stability_map.seed,
            "points": len(stability_map.x.values),
        }
        names = [stability_map.mechanism] if subject is None else [name]
        law = ("--compensator", stability_map.compensator)
        yield _format_command(
            "map", *names, "--x", axes[0], "--y", axes[1], *law, *gain_words, *_option_words(options)
        )
    if (document := results.identification) is not None:
        yield _format_command("identify", *document.sources, "--seed", str(document.seed))
    if (document := results.monitoring) is not None:
        yield _format_command("monitor", document.mechanism, *document.sources)


def _format_command(*words: str) -> str:
    """Return a command of `jaxhil` as typed in a shell."""
    return to_one_line(" ".join(["jaxhil", *map(shlex.quote, words)]), 2000)


def _option_words(values: Mapping[str, object]) -> Iterator[str]:
    """Yield the command-line words `--name value` of all options whose value is not None."""
    for name, value in values.items():
        if value is not None:
            yield from (f"--{name}", str(value))


def _software_versions(results: Results) -> dict[str, str]:
    """Return the versions, by package, of the software that computed the results."""
    subject, versions = results.subject, {}
    if subject is not None and isinstance(stated := subject.document.get("versions"), Mapping):
        versions = {str(name): str(value) for name, value in stated.items()}
    for document in (results.identification, results.monitoring):
        versions = versions if document is None else document.versions | versions
    return versions


def _format_metric(metric: MetricEntry | None) -> str:
    """Return a metric with its confidence interval as text."""
    if metric is None:
        return format_number(None)
    interval = (
        "" if metric.low is None else f" ({format_number(metric.low, 3)} to {format_number(metric.high, 3)})"
    )
    return format_number(metric.value, 3) + interval


def _format_margin(margin: MarginOfMap) -> str:
    low = "below the map" if margin.low is None else format_number(margin.low)
    high = "above the map" if margin.high is None else format_number(margin.high)
    return f"from {low} to {high}"
