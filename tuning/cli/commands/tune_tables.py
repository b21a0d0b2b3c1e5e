"""What `jaxhil tune` prints of its results: one mechanism in detail, or many side by side."""

import math
from typing import Any

from tuning import terminal
from tuning.cli.options import Tune
from tuning.front_door.tune_verdict import verdict_line


def print_overview(options: Tune, results: list[Any], entries: list[dict[str, Any]], drawn: bool) -> None:
    """All mechanisms side by side."""
    rows = []
    # A column of noughts would only push the names onto two lines.
    some_failed = any(result.figures["tuned"].failed for result in results)
    for result, entry in zip(results, entries, strict=True):
        tuned = result.figures["tuned"]
        best = min(result.starts, key=lambda start: start.rms).status if result.starts else "nothing to tune"
        verdict = entry["verdict"] if entry["better_than_literature"] else "NOT better than the literature's"
        rms = (result.figures[key].rms for key in ("before", "literature", "tuned"))
        above = [f"{100 * result.global_comparison.above:+.1f} %"] if result.global_comparison else []
        failed = [tuned.failed] if some_failed else []
        rows.append((entry["mechanism"], *rms, tuned.p99, tuned.peak_ratio, *failed, *above, best, verdict))
    headings = ["mechanism", "before", "literature", "tuned", "99th pct", "peak ratio"]
    headings += ["not ended"] if some_failed else []
    headings += ["above best"] if results[0].global_comparison else []
    error = (
        "e - e*, or of both errors in six axes,"
        if any("energy_error" in one for one in entries)
        else "e - e*"
    )
    terminal.emit(
        terminal.table(
            f"rms of {error} on {options.validation} fresh scenarios each, {options.compensator}",
            [*headings, "best start", "verdict"],
            rows,
            texts=(0, len(headings), len(headings) + 1),
        )
    )
    if not drawn:
        terminal.emit(f"wrote {options.output}/NAME/gains.json and {options.output}/overview.png", "")


def print_one(options: Tune, result: Any, entry: dict[str, Any]) -> None:
    """Errors, gains and starts of one mechanism, and the verdict."""
    if "energy_error" in entry:
        tables = [_two_errors(options, result, entry)]
    else:
        tables = [_errors(options, result, entry["better_than_literature"])]
    tables += [_transparency(result)] if result.transparency else []
    tables += [*_gains(options, result), *([_starts(options, result)] if result.starts else [])]
    closing = [*_aims(options, result)]
    closing += [f"wrote {path}" for path in (entry["gain_file"], *entry["plots"])]
    if not entry["sensor_noise"]:
        noise = "'{force=0.5,torque=0.05}'" if "energy_error" in entry else "2.67"
        closing.append(f"No sensor noise in the mechanism; with it: --set rig.force_sensor.noise_std={noise}")
    closing.append("took: " + ", ".join(f"{stage} {time:.1f} s" for stage, time in result.timings.items()))
    terminal.emit(*tables, *_how_sure(result), *closing, verdict_line(result, options.limit), "")


def _errors(options: Tune, result: Any, better: bool) -> Any:
    names = {"before": "before (uncompensated)", "literature": "literature's rule", "tuned": "tuned"}
    judged, rows = {**result.figures}, []
    if result.without_noise is not None:
        names["without noise"], judged["without noise"] = "tuned, without noise", result.without_noise
    for key, label in names.items():
        one = judged[key]
        if key == "tuned" and not better:
            label = "tuned (NOT better than the literature's)"
        rows.append(
            (
                *(label, one.rms, one.p99, one.max, f"{one.mean:+.4f}", f"{100 * one.diverging:.0f} %"),
                *(f"{one.peak_ratio:.3f}", f"{one.chatter:.3f}", one.failed),
            )
        )
    count = int(result.outcomes["tuned"].wanted.sum())
    return terminal.table(
        f"{result.mechanism.name}: errors e - e* of {count} contacts in {options.validation} fresh scenarios",
        ["gains", "rms", "99th pct", "max", "mean", "e > e*", "peak ratio", "chatter", "not ended"],
        rows,
    )


def _two_errors(options: Tune, result: Any, entry: dict[str, Any]) -> Any:
    """Of six axes: what remains of the energy and of the twist."""
    names = {"before": "before (uncompensated)", "literature": "literature's rule", "tuned": "tuned"}
    if not entry["better_than_literature"]:
        names["tuned"] = "tuned (NOT better than the literature's)"
    rows = []
    for key, label in names.items():
        for error in ("energy_error", "twist_error"):
            one = entry[error][key]
            figures = one.rms, one.p99, one.max, f"{one.mean:+.4f}", f"{one.peak_ratio:.3f}", one.failed
            rows.append((label if error == "energy_error" else "", error.replace("_", " "), *figures))
    count = int(result.outcomes["tuned"].wanted.sum()) // 2
    return terminal.table(
        f"{result.mechanism.name}: errors of {count} episodes in {options.validation} fresh scenarios",
        ["gains", "error", "rms", "99th pct", "max", "mean", "peak ratio", "not ended"],
        rows,
        texts=(0, 1),
    )


def _gains(options: Tune, result: Any) -> list[Any]:
    """The table of gains; none of a law without any."""
    from jaxhil.laws.compensators import compensator_of

    mechanism = result.mechanism
    rows = [
        (
            *(gain.name, gain.unit, float(gain.lower(mechanism)), float(gain.upper(mechanism))),
            result.literature[gain.name],
            result.gains[gain.name] if gain.tuned(mechanism) else "(not tuned)",
            *([f"{100 * share:.1f} %" for share in result.freedom.get(gain.name, ())] or ["", ""]),
        )
        for gain in compensator_of(options.compensator).gains
    ]
    headings = ["gain", "unit", "lower", "upper", "literature", "tuned", "free alone", "together"]
    return [terminal.table(f"Gains of {options.compensator}", headings, rows, texts=(0, 1))] if rows else []


def _aims(options: Tune, result: Any) -> list[str]:
    """Say which gains were sought, where that depends on what was found."""
    if not result.settings.quiet or result.without_noise is None or not result.starts:
        return []
    if result.quiet:
        return [f"Quietest gains found within {options.limit:g}; of least error: --noise-weight 0."]
    return [
        f"Gains of least error: none were found well within {options.limit:g}, of which to take the quietest."
    ]


def _how_sure(result: Any) -> list[str]:
    """What there is to say of how sure the optimum is."""
    sure_of = []
    if result.freedom:
        sure_of.append(
            "Free: the share of its range by which a gain may move, alone or with the others moved along, "
            "before the loss rises by 1 %."
        )
    ends = sorted(start.rms for start in result.starts if math.isfinite(start.rms))
    if result.settings.probed and len(ends) > 1:
        above = 100 * (ends[-1] / ends[0] - 1)
        sure_of.append(
            f"Starts: {len(ends)} of {len(result.starts)} ended, the worst {above:.1f} % above the best."
        )
    if result.global_comparison:
        one = result.global_comparison
        sure_of.append(
            f"Best of {one.evaluations} evaluations anywhere: {one.best:.4g}; tuned, with {one.spent}: "
            f"{one.tuned:.4g}, {100 * abs(one.above):.1f} % {'above' if one.above > 0 else 'below'} it."
        )
    return sure_of


def _transparency(result: Any) -> Any:
    """Whether it still is a test of the hardware, with the literature's and with tuned gains."""
    labels = {"literature": "literature's rule", "tuned": "tuned"}
    rows = [
        [label, *(_with_ends(one) for one in result.transparency[key].values())]
        for key, label in labels.items()
    ]
    return terminal.table(
        "Honesty: transparency to an early and a late push, slope of e against e*, peak command (95 %)",
        ["gains", *result.transparency["tuned"]],
        rows,
    )


def _with_ends(figure: Any) -> str:
    value, low, high = (terminal.figure(float(number), 3) for number in figure)
    return f"{value} ({low} to {high})"


def _starts(options: Tune, result: Any) -> Any:
    """Every start; a column of where they began, where one did not begin as usual."""
    figure = "objective" if result.settings.probed else options.objective
    headings = ["start", "status", "steps", f"{figure} on training scenarios"]
    rows: list[list[Any]] = [[n, s.status, s.steps, s.rms] for n, s in enumerate(result.starts, start=1)]
    if not result.first:
        return terminal.table("Starts", headings, rows, texts=(1,))
    begun = ["literature", *["spread"] * (len(rows) - 1)]
    for number, one in enumerate(result.first, start=result.usual_starts):
        begun[number] = f"gains of {one.source}"
    rows = [[*row, place] for row, place in zip(rows, begun, strict=True)]
    return terminal.table("Starts", [*headings, "begins at"], rows, texts=(1, 4))
