"""What studies found, in sections: runs, errors, what drives them, rare ones, other laws, the commands."""

import shlex
from collections.abc import Callable, Iterator, Mapping

from jaxhil.errors import one_line
from jaxhil.simulation.contact_bounds import STATED
from tuning.reporting.content import Section, Table, number
from tuning.reporting.documents import Figure, MarginOfMap
from tuning.reporting.drawings import TYPICAL, map_drawing, nominal_drawing, sweep_drawings
from tuning.reporting.reading import Results

FIGURES = {  # of a comparison: heading and what it says
    "rms": "rms |e - e*|", "p99": "99th percentile", "worst": "worst", "failures": "failures",
    "early": "early", "late": "late", "slope": "slope", "peak": "peak", "noise": "noise",
}  # fmt: skip
TRANSPARENCY = (
    "Early, late: by how much a push on the hardware at 25 and 75 % of the contact's duration in space "
    "reaches the result (1: as in space, 0: not at all). Slope: of e against e* over damped twins of the "
    "mechanism (1: as in space). Peak: largest command over the reference's peak force. Noise: of the "
    "command over that of the readings."
)


def pictures(results: Results) -> int:
    """How many pictures there are to be drawn, at most."""
    scenarios = 0 if results.sweep is None or results.axes == 6 else len(results.sweep.worst) + TYPICAL + 1
    return (results.subject is not None) + scenarios + (results.map is not None)


def runs(results: Results, say: Callable[[str], None]) -> Section | None:
    """The nominal run and scenarios of the sweep as traces."""
    if results.subject is None:
        return None
    say("the nominal run")
    drawings, traces, texts = [nominal_drawing(results.subject)], [], []
    if results.axes == 6:
        return Section("runs", "The nominal run", texts, [], drawings, traces)
    if results.store is not None and results.sweep is not None:
        say("scenarios of the sweep")
        points, traces = sweep_drawings(results.store, results.sweep.worst, say)
        drawings.append(points)
        texts.append(
            "Scenarios of the sweep: the worst, and some between the smallest error and the largest."
        )
    return Section("runs", "The nominal run and the worst ones", texts, [], drawings, traces)


def errors(results: Results) -> Section | None:
    """How errors are distributed."""
    found = results.sweep
    if found is None:
        return None
    rows = [
        (f"{100 * one.order:g} %", number(one.value), f"{number(one.low)} to {number(one.high)}")
        for one in found.error_quantiles
    ]
    tables = [Table(("share of scenarios", f"worst {results.error} up to", "95 %"), rows)]
    ended = [
        (one, str(count), f"{count / max(found.scenarios, 1):.4g}") for one, count in found.outcomes.items()
    ]
    tables.append(Table(("outcome", "scenarios", "share"), ended))
    how = f"{found.scenarios} scenarios, {found.sampling}, seed {found.seed}, {found.precision}"
    method = one_line(found.failure_probability.method, 200)
    texts = [f"{how}. Interval of the failure probability: {method}."]
    return Section("errors", "How large the error is, and how often", texts, tables)


def drivers(results: Results) -> Section | None:
    """What drives the error, and how probable rare ones are."""
    found = results.sweep
    if found is None or (found.drivers is None and found.rare is None):
        return None
    tables, texts = [], []
    if (own := found.drivers) is not None:
        rows = [
            (
                one.input,
                number(one.first_order, 3),
                f"{number(one.first_order_low, 3)} to {number(one.first_order_high, 3)}",
                number(one.total, 3),
                f"{number(one.total_low, 3)} to {number(one.total_high, 3)}",
            )
            for one in own.inputs
        ]
        tables.append(Table(("input", "first order", "95 %", "total", "95 %"), rows))
        texts.append(
            f"Sobol indices: shares of the variance of the worst {results.error}, cut at {own.cap:g} "
            f"({own.capped} of {own.evaluations} runs)."
        )
    if (rare := found.rare) is not None:
        interval = f"{number(rare.low, 3)} to {number(rare.high, 3)}"
        row = (number(rare.limit), number(rare.probability, 3), interval, str(rare.evaluations))
        tables.append(Table((f"{results.error} beyond", "probability", "95 %", "scenarios"), [row], 0))
        if rare.spread_beyond_formula:
            texts.append(
                "The replicates of the subset simulation differ far more than its formula explains: some "
                "have missed failures, and the interval may too."
            )
    return Section("drivers", "What drives it, and rare errors", texts, tables)


def comparison(results: Results) -> Section | None:
    """Other laws on the same scenarios, and transparency."""
    found = results.comparison
    if found is None:
        return None
    subject, tables, texts = results.subject, [], [TRANSPARENCY]
    for one in found.mechanisms:
        if subject is not None and one.mechanism != subject.mechanism.name:
            continue
        rows = [
            (f"{law.law}, {which}", *(_estimated(figures.get(key)) for key in FIGURES))
            for law in one.laws
            for which, figures in law.figures.items()
        ]
        tables.append(Table((one.mechanism, *FIGURES.values()), rows))
    texts.append(f"{found.judged} fresh scenarios for all; brackets: 95 %.")
    return Section("comparison", "Transparency, and other laws", texts, tables)


def stability_map(results: Results, say: Callable[[str], None]) -> Section | None:
    """The map, and the margins of its nominal point."""
    found = results.map
    if found is None:
        return None
    say("the stability map")
    texts, rows = [], []
    if found.nominal.error is not None:
        texts.append(f"At the nominal point the largest error is {found.nominal.error:+.4f}.")
    if found.nominal.peak_force_ratio is not None:
        texts.append(
            f"There the largest real force is {number(found.nominal.peak_force_ratio, 3)} times the ideal "
            f"contact's, and its duration {number(found.nominal.duration_ratio, 3)} times."
        )
    if (grown := found.nominal.growth) is not None:
        verb = "grows" if grown.per_second > 0 else "decays"
        texts.append(
            f"A contact that lasts {verb} by {abs(grown.per_second):.4g} per second "
            f"(spectral radius {grown.spectral_radius:.6f} a control period)."
        )
    margins = found.nominal.margins
    for what, own in (
        (f"|e - e*| within {number(found.limit)}", margins.error),
        (STATED, margins.contact),
        ("spectral radius at most 1", margins.spectral_radius),
    ):
        for axis, key in (("x", found.x), ("y", found.y)):
            if own is not None and axis in own:
                rows.append((key.key, what, number(key.nominal), _range(own[axis]), key.unit))
    tables = [Table(("key", "condition", "nominal", "holds", "unit"), rows, 9)] if rows else []
    return Section("map", "Stability map", texts, tables, [map_drawing(found)])


def reproduction(results: Results) -> Section:
    """Where every figure comes from: files, digests, versions, commands."""
    sources = [(f"jaxhil {one.command}", one_line(str(one.path), 200), one.sha256) for one in results.sources]
    tables = [Table(("result of", "file", "SHA-256"), sources, 9)]
    for found in (results.identification, results.monitoring):
        if found is not None:
            logs = [(one_line(name, 200), sha256) for name, sha256 in found.sources.items()]
            tables.append(Table(("log", "SHA-256"), logs, 9))
    if versions := _versions(results):
        tables.append(Table(("version of", "with which the results were made"), list(versions.items()), 9))
    texts = ["Each of these commands, on the files above, prints the figures again."]
    return Section(
        "reproduction", "How to reproduce every figure", texts, tables, lines=list(_commands(results))
    )


def _commands(results: Results) -> Iterator[str]:
    paths = {one.command: str(one.path) for one in results.sources}
    subject, sweep = results.subject, results.sweep
    gains = paths.get("tune", paths.get("export", "GAINS"))
    if ("tune" in paths or "export" in paths) and results.axes == 1:
        yield _command("verify", paths.get("export", gains))
    if sweep is not None:
        options = {"scenarios": sweep.scenarios, "seed": sweep.seed, "sampling": sweep.sampling,
                   "precision": sweep.precision, "limit": sweep.limit,
                   "acceptable": sweep.acceptable}  # fmt: skip
        studies = (["--drivers"] if sweep.drivers else []) + (["--rare"] if sweep.rare else [])
        yield _command("sweep", gains, "-o", "again", *_options(options), *studies)
        for one in sweep.worst[:1]:
            yield _command("replay", paths["sweep"], str(one.index), "--plot", "worst.png")
    name = subject.mechanism.name if subject is not None else "MECHANISM"
    if (compared := results.comparison) is not None:
        names = [one.mechanism for one in compared.mechanisms]
        options = {"scenarios": compared.scenarios, "judged": compared.judged, "seed": compared.seed,
                   "limit": compared.limit}  # fmt: skip
        laws = list(dict.fromkeys(law.law for one in compared.mechanisms for law in one.laws))
        untuned = [] if compared.tuned else ["--untuned"]
        yield _command("compare", *names, *_options(options), *untuned, "--compensators", *laws)
    if (found := results.map) is not None:
        axes = [f"{one.key}={one.values[0]!r}:{one.values[-1]!r}" for one in (found.x, found.y)]
        given = ["--gains", gains] if found.gains and subject is not None else []
        options = {"limit": found.limit, "seed": found.seed, "points": len(found.x.values)}
        names = [found.mechanism] if subject is None else [name]
        law = ("--compensator", found.compensator)
        yield _command("map", *names, "--x", axes[0], "--y", axes[1], *law, *given, *_options(options))
    if (known := results.identification) is not None:
        yield _command("identify", *known.sources, "--seed", str(known.seed))
    if (known := results.monitoring) is not None:
        yield _command("monitor", known.mechanism, *known.sources)


def _command(*words: str) -> str:
    return one_line(" ".join(["jaxhil", *map(shlex.quote, words)]), 2000)


def _options(given: Mapping[str, object]) -> Iterator[str]:
    for name, value in given.items():
        if value is not None:
            yield from (f"--{name}", str(value))


def _versions(results: Results) -> dict[str, str]:
    subject, found = results.subject, {}
    if subject is not None and isinstance(known := subject.document.get("versions"), Mapping):
        found = {str(name): str(value) for name, value in known.items()}
    for one in (results.identification, results.monitoring):
        found = found if one is None else one.versions | found
    return found


def _estimated(one: Figure | None) -> str:
    if one is None:
        return number(None)
    interval = "" if one.low is None else f" ({number(one.low, 3)} to {number(one.high, 3)})"
    return number(one.value, 3) + interval


def _range(one: MarginOfMap) -> str:
    low = "below the map" if one.low is None else number(one.low)
    high = "beyond the map" if one.high is None else number(one.high)
    return f"from {low} to {high}"
