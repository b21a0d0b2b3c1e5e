"""Summary of a bundle for a printed A4 page: gains, limits, watchdog, errors, and range of validity.

The summary is one HTML file with an embedded plot.
"""

import base64
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

from jaxhil.errors import to_one_line
from jaxhil.mechanism.sensor_filter import low_frequency_delay
from jaxhil.mechanism.structs import SensorFilter
from jaxhil.simulation.contact_plot import CURVE_LABELS
from tuning.bundle.writers import GainOrLimit, gain_entries, limit_entries
from tuning.number_format import format_number
from tuning.plots.bundle_summary import ERROR_STATISTICS, summary_png

# Prefixes of those limits that are fitted coefficients of the watchdog's expected restitution.
FITTED_LIMIT_PREFIXES = ("expected_", "softness_", "speed_", "loss_", "reference_")

RIG_UNITS = {"m": "mm", "m/s": "mm/s", "s": "ms"}  # units of limits in tables, 1000 times smaller

PAGE_STYLE = """
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

# Keys of the figures with errors of fresh scenarios, and titles of their tables, by number of axes.
ERROR_TABLES = {
    1: (("robust", "Restitution error |e - e*| [1]"),),
    6: (("twist_error", "Twist error [1]"), ("energy_error", "Energy error [1]")),
}


def summary_html(document: Mapping[str, Any], drawn: bytes | None = None) -> bytes:
    """Return the HTML page that summarises a checked gain document.

    `drawn` is the plot as PNG; None to draw a new plot.
    """
    mechanism = document["mechanism"]
    name = escape(to_one_line(mechanism["name"], 80))
    plot = base64.b64encode(summary_png(document) if drawn is None else drawn).decode("ascii")
    error_tables = ERROR_TABLES[document.get("axes", 1)]
    error_name = error_tables[0][1].partition(" |")[0]
    versions = ", ".join(f"{key} {value}" for key, value in document["versions"].items())
    parts = [
        "<!DOCTYPE html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{name}: controller for the rig</title>',
        f"<style>{PAGE_STYLE}</style></head><body>",
        f"<h1>{name}: compensator {escape(document['compensator'])}</h1>",
        f"<p>{escape(describe_mechanism(mechanism, document.get('axes', 1)))}</p>",
        f"<p>Control period {format_number(1e3 * document['control_period'])} ms. "
        f"Tuned {escape(to_one_line(document['created'], 40))}; seed {document['seed']}; "
        f"{escape(to_one_line(versions, 200))}.<br>",
        f"SHA-256 of the gains' content <code>{escape(document['sha256'])}</code></p>",
        f'<img alt="{error_name}, and ranges of the uncertainty" src="data:image/png;base64,{plot}">',
        *(line for table in error_tables for line in _error_table(document, *table)),
        *(f"<p>{escape(text)}</p>" for text in describe_sweep(document["figures"].get("sweep"), error_name)),
        '<div class="columns"><div>',
        *_gain_table(document),
        *_watchdog_section(document),
        "</div><div>",
        *_limit_table(document),
        "</div></div>",
        "</body></html>",
    ]
    return ("\n".join(parts) + "\n").encode()


def describe_mechanism(mechanism: Mapping[str, Any], axes: int = 1) -> str:
    """Return a sentence that describes the mechanism and the rig."""
    if axes == 6:
        return _describe_six_axes(mechanism)
    bodies, contact, rig = mechanism["bodies"], mechanism["contact"], mechanism["rig"]
    mass = bodies.get("equivalent_mass")
    text = f"{format_number(mass)} kg" if mass else f"bodies of {_format_list(bodies.values())} kg"
    approach = mechanism["approach"]
    number = approach["contacts"]
    stiffness = _format_list(_flatten(contact["stiffness"]))
    return (
        f"{text} at {format_number(1e3 * approach['velocity'])} mm/s, {number} "
        f"contact{'s' if number > 1 else ''}, "
        f"{contact['law'].replace('_', ' ')} contact of stiffness {stiffness} (SI units); motion simulator "
        f"{rig['simulator']['model'].replace('_', ' ')}, delay "
        f"{format_number(1e3 * rig['simulator'].get('delay', 0.0))} ms; force sensor delay "
        f"{format_number(1e3 * rig['force_sensor'].get('delay', 0.0))} ms{_describe_filter(rig)}."
    )


def _describe_filter(rig: Mapping[str, Any]) -> str:
    """Describe the force sensor's filter and its delay at low frequencies; return "" without a filter."""
    stated = rig["force_sensor"].get("filter")
    if stated is None:
        return ""
    delay = format_number(1e3 * low_frequency_delay(SensorFilter(**stated)))
    name = f"{stated['kind']} filter of order {stated['order']} at {format_number(stated['cutoff'])} Hz"
    return f", {name} (another {delay} ms)"


def _describe_six_axes(mechanism: Mapping[str, Any]) -> str:
    """Return a sentence that describes a six-axis mechanism and its rig."""
    rig = mechanism["rig"]
    delays = _format_list((1e3 * delay for delay in _flatten([rig["simulator"].get("delay", 0.0)])), 6)
    approach = mechanism.get("approach")
    speed = f" at {_format_list(approach['velocity'])} m/s" if approach else ""
    contacts = ", ".join(
        f"{to_one_line(name, 30)} ({str(contact['law']).replace('_', ' ')})"
        for name, contact in (mechanism.get("contact") or {}).items()
    )
    return (
        f"Six axes: target of {format_number(mechanism['target']['mass'])} kg, chaser of "
        f"{format_number(mechanism['chaser']['mass'])} kg{speed}; contacts {contacts or 'none'}; motion "
        f"simulator {rig['simulator']['model'].replace('_', ' ')}, axes "
        f"{rig['simulator'].get('space', 'task').replace('_', ' ')}, delays {delays} ms; force sensor on the "
        f"{rig['force_sensor'].get('side', 'fixed')} side, delay "
        f"{format_number(1e3 * rig['force_sensor'].get('delay', 0.0))} ms{_describe_filter(rig)}."
    )


def _error_table(document: Mapping[str, Any], key: str, title: str) -> Iterator[str]:
    """Yield the HTML lines of a table with the errors in fresh scenarios, which the tuning did not use."""
    robust = document["figures"].get(key)
    rows = []
    for name, errors in robust.items() if isinstance(robust, Mapping) else ():
        if name in CURVE_LABELS and isinstance(errors, Mapping):
            cells = [
                *(errors.get(key) for key in (*ERROR_STATISTICS, "mean", "peak_ratio")),
                errors.get("failed"),
            ]
            rows.append((CURVE_LABELS[name], *(format_number(value) for value in cells)))
    if rows:
        heads = (
            "fresh scenarios",
            *ERROR_STATISTICS.values(),
            "mean",
            "peak command / ideal peak force",
            "not ended",
        )
        yield from _html_table(title, heads, rows)
    else:
        yield f"<p>The gain file contains no {title.partition(' |')[0].removesuffix(' [1]').lower()}s.</p>"


def describe_sweep(sweep: Any, error_name: str) -> Iterator[str]:
    """Yield a sentence on the failure probability that a sweep estimated; yield nothing without a sweep.

    Args:
        sweep: result of `tuning.sweeps.run_sweep.summarise_failures`, or None.
        error_name: name of the error; a scenario of the sweep fails if this error exceeds the limit.
    """
    if isinstance(sweep, Mapping) and isinstance(sweep.get("failure_probability"), Mapping):
        value, low, high = (sweep["failure_probability"].get(key) for key in ("value", "low", "high"))
        interval = f"95 %: {format_number(low, 3)} to {format_number(high, 3)}"
        limit = f"{error_name.removesuffix(' [1]').lower()} {format_number(sweep.get('limit'))}"
        yield (
            f"Sweep: failure probability {format_number(value)} ({interval}). {sweep.get('failed')} of "
            f"{sweep.get('scenarios')} scenarios failed; limit of the {limit}."
        )


def _gain_table(document: Mapping[str, Any]) -> Iterator[str]:
    rows = [
        (
            name,
            format_number(gain.value, 6),
            gain.unit,
            f"{format_number(gain.lower, 3)} to {format_number(gain.upper, 3)}",
        )
        for name, gain in gain_entries(document).items()
    ]
    if rows:
        yield from _html_table("Gains", ("gain", "value", "unit", "bounds"), rows)
    else:
        yield "<h2>Gains</h2><p>None: the force command is the measured force.</p>"


def _limit_table(document: Mapping[str, Any]) -> Iterator[str]:
    limits = _active_limits(document)
    if not limits:
        yield "<h2>Limits</h2><p>None in the gain file: the controller's widest limits hold.</p>"
        return
    rows = [
        (name, *describe_limit(limit.value, limit.unit))
        for name, limit in limits.items()
        if is_user_limit(name)
    ]
    yield from _html_table("Limits", ("limit", "value", "unit"), rows, (1,))


def _watchdog_section(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the HTML lines on the watchdog: verdict, alarm rates, and the limits that are not set."""
    limits = _active_limits(document)
    if not limits:
        return
    yield "<h2>Watchdog</h2>"
    rates = document["figures"].get("watchdog")
    rates = rates if isinstance(rates, Mapping) else {}
    if rates.get("verdict"):
        yield f"<p><b>{escape(_watchdog_verdict(rates))}</b></p>"
    rates_text = to_one_line("; ".join(describe_alarm_rates(rates)), 1500)
    rates_text = rates_text or "Rates of false and missed alarms are not known"
    yield f"<p>{escape(rates_text[0].upper() + rates_text[1:])}.</p>"
    fitted = sum(not is_user_limit(name) for name in limits)
    if fitted:
        yield f"<p>Expected restitution: {fitted} fitted coefficients in the gain file.</p>"
    unset = [name for name in document["limits"] if name not in limits]
    if unset:
        yield f'<p class="note">Not set, the widest limit holds: {escape(", ".join(unset))}.</p>'


def _watchdog_verdict(rates: Mapping[str, Any]) -> str:
    """Return a sentence with the verdict on the alarm rates and its reasons."""
    texts = [text for key in ("reasons", "unknown") for text in rates.get(key, ()) if isinstance(text, str)]
    reasons = "; ".join(texts) or "the rates of wrong alarms are within their limits"
    return to_one_line(f"{str(rates['verdict']).capitalize()}: {reasons}.", 500)


def _active_limits(document: Mapping[str, Any]) -> dict[str, GainOrLimit]:
    """Return those limits of a gain document that are set (not null)."""
    entries = limit_entries(document)
    return {name: entry for name, entry in entries.items() if document["limits"][name]["value"] is not None}


def describe_limit(value: float | None, unit: str) -> tuple[str, str]:
    """Return a limit as text and its unit, with lengths in mm, speeds in mm/s and times in ms."""
    if unit not in RIG_UNITS:
        return format_number(value), unit
    return format_number(None if value is None else 1e3 * value), RIG_UNITS[unit]


def is_user_limit(limit: str) -> bool:
    """Return whether a limit is one that users set, and not a fitted coefficient of the watchdog."""
    return not limit.startswith(FITTED_LIMIT_PREFIXES)


def describe_alarm_rates(rates: Mapping[str, Any]) -> Iterator[str]:
    """Yield texts on the rates of false and missed alarms, and on the errors that the watchdog detects."""
    for name, runs in (("false_alarms", "good runs"), ("missed_alarms", "runs to be stopped")):
        rate = rates.get(name)
        if isinstance(rate, Mapping) and {"runs", "alarms", "low", "high"} <= rate.keys():
            allowed = f", limit {format_number(rate['allowed'], 2)}" if "allowed" in rate else ""
            interval = f"95 %: {format_number(rate['low'], 2)} to {format_number(rate['high'], 2)}{allowed}"
            yield f"{name.replace('_', ' ')} {rate['alarms']} of {rate['runs']} {runs} ({interval})"
    for rate in rates.get("fault_runs", ()):
        if isinstance(rate, Mapping) and {"counted", "runs", "alarms", "low", "high", "error"} <= rate.keys():
            yield _describe_missed_faults(rate)
    noticed = rates.get("noticed_from")
    if isinstance(noticed, Mapping):
        yield from _describe_noticed_errors(noticed, rates)
    calibrated = rates.get("calibrated_on")
    if isinstance(calibrated, Mapping) and calibrated.get("runs") not in (None, "good"):
        yield "no run was good, so the limits were calibrated on runs with errors beyond the limit"


def _describe_missed_faults(runs: Mapping[str, Any]) -> str:
    """Return a text on how often the watchdog misses an injected fault of known size."""
    unit = "" if runs["unit"] == "1" else f" {runs['unit']}"
    if not runs["counted"]:
        most = f"up to {format_number(runs['largest_size'], 2)}{unit}"
        usable = f"only {runs['runs']} of {runs['scenarios']} runs are good without and bad with the fault"
        return f"{runs['meaning']}, {most}: not counted, {usable}"
    interval = f"95 %: {format_number(runs['low'], 2)} to {format_number(runs['high'], 2)}"
    interval += f", limit {format_number(runs['allowed'], 2)}"
    size = f"size {format_number(runs['size'], 2)}{unit}, error {format_number(runs['error'], 2)}"
    return (
        f"missed alarms {runs['alarms']} of {runs['runs']} runs with {runs['meaning']}, {size} ({interval})"
    )


def _describe_noticed_errors(noticed: Mapping[str, Any], rates: Mapping[str, Any]) -> Iterator[str]:
    """Yield texts on a widened `restitution_margin`, and on the smallest error that the watchdog detects."""
    if rates.get("widened_from") is not None:
        widened = (
            f"{format_number(rates['widened_from'], 2)} to {format_number(rates['restitution_margin'], 2)}"
        )
        yield f"restitution_margin widened from {widened}, because too many good runs would be stopped"
    if noticed.get("error") is not None:
        yield f"errors above {format_number(noticed['error'], 2)} are detected in 95 % of contacts"
    elif noticed.get("largest") is not None:
        largest = format_number(noticed["largest"], 2)
        yield (
            "the smallest error that is detected in 95 % of contacts is above "
            f"{largest}, the largest error of these runs"
        )


def _html_table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] | None = None
) -> Iterator[str]:
    """Yield the lines of an HTML table; `numbers` are the indices of the right-aligned columns.

    By default, all columns except the first column and the column "unit" are right-aligned.
    """
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


def _format_list(values: Any, most: int = 4) -> str:
    """Return the first `most` numbers as text, followed by "..." if there are more."""
    texts = [format_number(value) for value in values]
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")


def _flatten(value: Any) -> Iterator[float]:
    """Yield the numbers of nested lists."""
    for entry in value:
        yield from _flatten(entry) if isinstance(entry, (list, tuple)) else (entry,)
