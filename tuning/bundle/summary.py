"""Summary of a bundle on one page: purpose, gains, limits, watchdog, errors, and range of validity.

It is one HTML file with an embedded picture, made for one printed sheet of A4.
"""

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxhil.errors import one_line
from jaxhil.simulation.contact_plot import BLACK, BLUE, LABELS, ORANGE, VERMILION, finish
from tuning.bundle.writers import Entry, gain_entries, limit_entries

COLOURS = {"before": VERMILION, "literature": ORANGE, "tuned": BLUE}
HATCHES = {"before": "///", "literature": "...", "tuned": ""}
KEYS = {"rms": "rms", "p99": "99th percentile", "max": "largest"}  # statistics of |e - e*|
QUANTITIES = {
    "contact_frequency": ("contact frequency", "Hz", 1.0),
    "delay": ("delay", "ms", 1e3),
    "approach_velocity": ("approach velocity", "mm/s", 1e3),
    "force": ("contact force", "N", 1.0),
}

# Prefixes of the limits that are fitted numbers of the watchdog's expected restitution.
FITTED = ("expected_", "softness_", "speed_", "loss_", "reference_")

STYLE = """
@page { size: A4; margin: 11mm 12mm; }
* { box-sizing: border-box; }
body { font: 8.6pt/1.25 Arial, sans-serif; color: #000; max-width: 186mm; margin: 0 auto; }
h1 { font-size: 15pt; margin: 0 0 1mm; } h2 { font-size: 10pt; margin: 2.5mm 0 0.8mm; }
p { margin: 0.8mm 0; } code { font-size: 7.4pt; overflow-wrap: anywhere; }
.columns { display: flex; gap: 7mm; align-items: flex-start; } .columns > div { flex: 1 1 0; }
.columns > div:first-child { flex-grow: 1.2; }
table { border-collapse: collapse; width: 100%; font-size: 7.8pt; }
td, th { text-align: left; padding: 0.25mm 2mm 0.25mm 0; border-bottom: 0.1mm solid #bbb; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
td, th { white-space: nowrap; } img { width: 100%; margin-top: 2mm; } .note { color: #333; }
"""


def summary_html(document: Mapping[str, Any], drawn: bytes | None = None) -> bytes:
    """Return the page of a checked gain document; `drawn` is its picture (PNG), None to draw it."""
    mechanism = document["mechanism"]
    name = escape(one_line(mechanism["name"], 80))
    picture = base64.b64encode(picture_png(document) if drawn is None else drawn).decode("ascii")
    versions = ", ".join(f"{key} {value}" for key, value in document["versions"].items())
    parts = [
        "<!DOCTYPE html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{name}: controller for the rig</title>',
        f"<style>{STYLE}</style></head><body>",
        f"<h1>{name}: compensator {escape(document['compensator'])}</h1>",
        f"<p>{escape(about(mechanism))}</p>",
        f"<p>Control period {_number(1e3 * document['control_period'])} ms. "
        f"Tuned {escape(one_line(document['created'], 40))}; seed {document['seed']}; "
        f"{escape(one_line(versions, 200))}.<br>",
        f"SHA-256 of the gains' content <code>{escape(document['sha256'])}</code></p>",
        f'<img alt="Restitution error, and what was tuned over" src="data:image/png;base64,{picture}">',
        *_figures(document),
        '<div class="columns"><div>',
        *_gains(document),
        *_watchdog(document),
        "</div><div>",
        *_limits(document),
        "</div></div>",
        "</body></html>",
    ]
    return ("\n".join(parts) + "\n").encode()


def about(mechanism: Mapping[str, Any]) -> str:
    """Return a sentence on the mechanism and the rig."""
    bodies, contact, rig = mechanism["bodies"], mechanism["contact"], mechanism["rig"]
    mass = bodies.get("equivalent_mass")
    text = f"{_number(mass)} kg" if mass else f"bodies of {_listed(bodies.values())} kg"
    approach = mechanism["approach"]
    number = approach["contacts"]
    stiffness = _listed(_flat(contact["stiffness"]))
    return (
        f"{text} at {_number(1e3 * approach['velocity'])} mm/s, {number} contact{'s' if number > 1 else ''}, "
        f"{contact['law'].replace('_', ' ')} contact of stiffness {stiffness} (SI units); motion simulator "
        f"{rig['simulator']['model'].replace('_', ' ')}, delay "
        f"{_number(1e3 * rig['simulator'].get('delay', 0.0))} ms; force sensor delay "
        f"{_number(1e3 * rig['force_sensor'].get('delay', 0.0))} ms."
    )


@matplotlib.style.context("default")
def picture_png(document: Mapping[str, Any]) -> bytes:
    """Draw the restitution error before and after tuning, and the ranges that the gains were tuned over."""
    figure = Figure(figsize=(9.3, 3.1))
    FigureCanvasAgg(figure)
    left = figure.add_axes((0.075, 0.2, 0.48, 0.6))
    _errors(left, document)
    spans = [(key, span) for key, span in document["envelope"].items() if _is_span(span)][:4]
    figure.text(0.61, 0.93, "Tuned over (the gains hold there)", fontsize=10, va="center")
    if not spans:
        figure.text(0.61, 0.5, "the gain file does not say", fontsize=9)
    for number, (key, span) in enumerate(spans):
        _strip(figure.add_axes((0.63, 0.72 - 0.2 * number, 0.34, 0.06)), key, span)
    file = io.BytesIO()
    figure.savefig(file, dpi=160, format="png", metadata={"Software": None})
    return file.getvalue()


def _errors(axes: Axes, document: Mapping[str, Any]) -> None:
    """Draw groups of bars: errors of the nominal run and of fresh scenarios, by gains."""
    groups = _error_groups(document["figures"])
    series = [name for name in COLOURS if any(name in values for _, values in groups)]
    width = 0.8 / max(1, len(series))
    axes.set_title("Restitution error |e - e*|", fontsize=10, loc="left", y=1.13)
    for index, name in enumerate(series):
        heights = [(i, values[name]) for i, (_, values) in enumerate(groups) if name in values]
        centres = [i + (index - (len(series) - 1) / 2) * width for i, _ in heights]
        bars = axes.bar(
            centres, [value for _, value in heights], width * 0.92, color=COLOURS[name], hatch=HATCHES[name],
            edgecolor="white", linewidth=0.4, label=LABELS[name].partition(":")[0],
        )  # fmt: skip
        axes.bar_label(bars, [f"{value:.2g}" for _, value in heights], fontsize=6, padding=1)
    axes.set_xticks(range(len(groups)), [label for label, _ in groups], fontsize=8)
    axes.tick_params(axis="y", labelsize=8)
    axes.set_ylabel("|e - e*| [1]", fontsize=9)
    finish(axes, None)
    axes.grid(False, axis="x")
    positive = [value for _, values in groups for value in values.values() if value > 0]
    if positive:
        axes.set_yscale("log")
        axes.set_ylim(min(positive) / 2, max(positive) * 3)
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 0.98), ncols=3, fontsize=8, frameon=False, borderaxespad=0.2
        )


def _error_groups(figures: Mapping[str, Any]) -> list[tuple[str, dict[str, float]]]:
    """Return the label of each group of bars, and the error by gains."""
    groups = []
    for kind, key, label in (
        ("nominal", "rms", "nominal run,\nrms"),
        *(("robust", key, f"scenarios,\n{text}") for key, text in KEYS.items()),
    ):
        errors = figures.get(kind, {})
        values = {
            name: statistics[key]
            for name, statistics in (errors.items() if isinstance(errors, Mapping) else ())
            if name in COLOURS
            and isinstance(statistics, Mapping)
            and isinstance(statistics.get(key), (int, float))
        }
        if values:
            groups.append((label, values))
    return groups


def _strip(axes: Axes, key: str, span: Mapping[str, Any]) -> None:
    """Draw the range of one quantity on its own axis."""
    name, unit, factor = QUANTITIES.get(key, (key.replace("_", " "), span["unit"], 1.0))
    low, high = sorted((factor * span["low"], factor * span["high"]))
    room = 0.25 * (high - low) or 0.25 * abs(high) or 1.0
    axes.barh(0, high - low, left=low, height=1, color=BLUE)
    axes.plot([low, high], [0, 0], linestyle="none", marker="|", color=BLACK, markersize=9)
    axes.set(xlim=(low - room, high + room), ylim=(-0.9, 0.9), yticks=[])
    axes.tick_params(axis="x", labelsize=7, pad=1.5)
    axes.set_title(
        f"{one_line(name, 30)}: {low:.3g} to {high:.3g} {one_line(unit, 10)}", fontsize=8, loc="left", pad=3
    )
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _figures(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of errors on fresh scenarios."""
    robust = document["figures"].get("robust")
    rows = []
    for name, errors in robust.items() if isinstance(robust, Mapping) else ():
        if name in LABELS and isinstance(errors, Mapping):
            cells = [*(errors.get(key) for key in (*KEYS, "mean", "peak_ratio")), errors.get("failed")]
            rows.append((LABELS[name], *(_number(value) for value in cells)))
    if rows:
        heads = ("fresh scenarios", *KEYS.values(), "mean e - e*", "peak force / reference", "not ended")
        yield from _table("What is reached: restitution error |e - e*| [1]", heads, rows)
    else:
        yield "<p>The gain file holds no figures of what the gains reach.</p>"


def _gains(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of gains."""
    rows = [
        (name, _number(gain.value, 6), gain.unit, f"{_number(gain.lower, 3)} to {_number(gain.upper, 3)}")
        for name, gain in gain_entries(document).items()
    ]
    if rows:
        yield from _table("Gains", ("gain", "value", "unit", "bounds"), rows)
    else:
        yield "<h2>Gains</h2><p>None: the measured force is passed on.</p>"


def _limits(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of limits."""
    limits = _active_limits(document)
    if not limits:
        yield "<h2>Limits</h2><p>None in the gain file: those of the code hold.</p>"
        return
    rows = [(name, _number(limit.value, 5), limit.unit) for name, limit in limits.items() if is_shown(name)]
    yield from _table("Limits", ("limit", "value", "unit"), rows, (1,))


def _watchdog(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the verdict on the watchdog, its alarm rates, and the limits that are not set."""
    limits = _active_limits(document)
    if not limits:
        return
    yield "<h2>Watchdog</h2>"
    rates = document["figures"].get("watchdog")
    rates = rates if isinstance(rates, Mapping) else {}
    if rates.get("verdict"):
        yield f"<p><b>{escape(_verdict(rates))}</b></p>"
    rates_text = one_line("; ".join(alarm_rates(rates)), 1500)
    rates_text = rates_text or "Rates of false and missed alarms are not known"
    yield f"<p>{escape(rates_text[0].upper() + rates_text[1:])}.</p>"
    fitted = sum(not is_shown(name) for name in limits)
    if fitted:
        yield f"<p>Its expected restitution: {fitted} fitted numbers in the gain file.</p>"
    unset = [name for name in document["limits"] if name not in limits]
    if unset:
        yield f'<p class="note">Limited by the code alone: {escape(", ".join(unset))}.</p>'


def _verdict(rates: Mapping[str, Any]) -> str:
    """Return the verdict on the alarm rates, and the reasons against them."""
    texts = [text for key in ("reasons", "unknown") for text in rates.get(key, ()) if isinstance(text, str)]
    reasons = "; ".join(texts) or "wrong alarms are as rare as allowed"
    return one_line(f"{str(rates['verdict']).capitalize()}: {reasons}.", 500)


def _active_limits(document: Mapping[str, Any]) -> dict[str, Entry]:
    """Return the limits that have a value."""
    entries = limit_entries(document)
    return {name: entry for name, entry in entries.items() if document["limits"][name]["value"] is not None}


def is_shown(limit: str) -> bool:
    """Return whether a limit is meaningful to people; fitted numbers of the watchdog are not."""
    return not limit.startswith(FITTED)


def alarm_rates(rates: Mapping[str, Any]) -> Iterator[str]:
    """Yield texts on the rates of false and missed alarms, and on the errors that are noticed."""
    for name, runs in (("false_alarms", "good runs"), ("missed_alarms", "runs to be stopped")):
        rate = rates.get(name)
        if isinstance(rate, Mapping) and {"runs", "alarms", "low", "high"} <= rate.keys():
            allowed = f", allowed {_number(rate['allowed'], 2)}" if "allowed" in rate else ""
            interval = f"95 %: {_number(rate['low'], 2)} to {_number(rate['high'], 2)}{allowed}"
            yield f"{name.replace('_', ' ')} {rate['alarms']} of {rate['runs']} {runs} ({interval})"
    for rate in rates.get("fault_runs", ()):
        if isinstance(rate, Mapping) and {"counted", "runs", "alarms", "low", "high", "error"} <= rate.keys():
            yield _faulty(rate)
    noticed = rates.get("noticed_from")
    if isinstance(noticed, Mapping):
        yield from _noticed(noticed, rates)
    calibrated = rates.get("calibrated_on")
    if isinstance(calibrated, Mapping) and calibrated.get("runs") not in (None, "good"):
        yield "no run was good: the limits come from runs with errors beyond the limit"


def _faulty(runs: Mapping[str, Any]) -> str:
    """Return a text on how often a fault of known size is missed."""
    unit = "" if runs["unit"] == "1" else f" {runs['unit']}"
    if not runs["counted"]:
        most = f"up to {_number(runs['largest_size'], 2)}{unit}"
        usable = f"{runs['runs']} of {runs['scenarios']} runs are good without it and just bad with it"
        return f"{runs['meaning']}, {most}: not counted, {usable}"
    interval = f"95 %: {_number(runs['low'], 2)} to {_number(runs['high'], 2)}"
    interval += f", allowed {_number(runs['allowed'], 2)}"
    size = f"by {_number(runs['size'], 2)}{unit}, error {_number(runs['error'], 2)}"
    return (
        f"missed alarms {runs['alarms']} of {runs['runs']} runs with {runs['meaning']}, {size} ({interval})"
    )


def _noticed(noticed: Mapping[str, Any], rates: Mapping[str, Any]) -> Iterator[str]:
    """Yield texts on the smallest error that is noticed in 95 % of contacts."""
    if rates.get("widened_from") is not None:
        widened = f"{_number(rates['widened_from'], 2)} to {_number(rates['restitution_margin'], 2)}"
        yield f"restitution_margin widened from {widened}, or too many good runs would be stopped"
    if noticed.get("error") is not None:
        yield f"errors from {_number(noticed['error'], 2)} on are noticed in 95 % of contacts"
    elif noticed.get("largest") is not None:
        yield f"no error that occurred, up to {_number(noticed['largest'], 2)}, is noticed in 95 %"


def _table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] | None = None
) -> Iterator[str]:
    """Yield the lines of an HTML table; columns `numbers` are right-aligned, by default all but the first."""
    right = set(range(1, len(heads)) if numbers is None else numbers)
    if numbers is None and "unit" in heads:
        right.discard(list(heads).index("unit"))

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(
            f'<{tag} class="n">{escape(value)}</{tag}>' if i in right else f"<{tag}>{escape(value)}</{tag}>"
            for i, value in enumerate(values)
        )

    yield f"<h2>{escape(title)}</h2><table><tr>{cells('th', heads)}</tr>"
    yield from (f"<tr>{cells('td', row)}</tr>" for row in rows)
    yield "</table>"


def _number(value: Any, digits: int = 4) -> str:
    """Return a number as text, or a dash if it is none."""
    return f"{value:.{digits}g}" if isinstance(value, (int, float)) else "-"


def _listed(values: Any, most: int = 4) -> str:
    """Return numbers as text, at most `most` of them."""
    texts = [_number(value) for value in values]
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")


def _flat(value: Any) -> Iterator[float]:
    """Yield the numbers of nested lists."""
    for entry in value:
        yield from _flat(entry) if isinstance(entry, (list, tuple)) else (entry,)


def _is_span(value: Any) -> bool:
    """Return whether a value is a range with numbers `low` and `high`."""
    return isinstance(value, Mapping) and all(
        isinstance(value.get(key), (int, float)) for key in ("low", "high")
    )
