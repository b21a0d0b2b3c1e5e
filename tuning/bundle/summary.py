"""Summary of a bundle on one page: purpose, gains, limits, watchdog, errors, and range of validity.

It is one HTML file with an embedded plot, made for one printed sheet of A4.
"""

import base64
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

from jaxhil.errors import to_one_line
from jaxhil.simulation.contact_plot import CURVE_LABELS
from tuning.bundle.writers import GainOrLimit, gain_entries, limit_entries
from tuning.plots.bundle_summary import ERROR_STATISTICS, summary_png

# Prefixes of the limits that are fitted numbers of the watchdog's expected restitution.
FITTED_LIMIT_PREFIXES = ("expected_", "softness_", "speed_", "loss_", "reference_")

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


def summary_html(document: Mapping[str, Any], drawn: bytes | None = None) -> bytes:
    """Return the page of a checked gain document; `drawn` is its plot (PNG), None to draw it."""
    mechanism = document["mechanism"]
    name = escape(to_one_line(mechanism["name"], 80))
    plot = base64.b64encode(summary_png(document) if drawn is None else drawn).decode("ascii")
    versions = ", ".join(f"{key} {value}" for key, value in document["versions"].items())
    parts = [
        "<!DOCTYPE html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{name}: controller for the rig</title>',
        f"<style>{PAGE_STYLE}</style></head><body>",
        f"<h1>{name}: compensator {escape(document['compensator'])}</h1>",
        f"<p>{escape(describe_mechanism(mechanism))}</p>",
        f"<p>Control period {_format_number(1e3 * document['control_period'])} ms. "
        f"Tuned {escape(to_one_line(document['created'], 40))}; seed {document['seed']}; "
        f"{escape(to_one_line(versions, 200))}.<br>",
        f"SHA-256 of the gains' content <code>{escape(document['sha256'])}</code></p>",
        f'<img alt="Restitution error, and what was tuned over" src="data:image/png;base64,{plot}">',
        *_error_table(document),
        '<div class="columns"><div>',
        *_gain_table(document),
        *_watchdog_section(document),
        "</div><div>",
        *_limit_table(document),
        "</div></div>",
        "</body></html>",
    ]
    return ("\n".join(parts) + "\n").encode()


def describe_mechanism(mechanism: Mapping[str, Any]) -> str:
    """Return a sentence on the mechanism and the rig."""
    bodies, contact, rig = mechanism["bodies"], mechanism["contact"], mechanism["rig"]
    mass = bodies.get("equivalent_mass")
    text = f"{_format_number(mass)} kg" if mass else f"bodies of {_format_list(bodies.values())} kg"
    approach = mechanism["approach"]
    number = approach["contacts"]
    stiffness = _format_list(_flatten(contact["stiffness"]))
    return (
        f"{text} at {_format_number(1e3 * approach['velocity'])} mm/s, {number} "
        f"contact{'s' if number > 1 else ''}, "
        f"{contact['law'].replace('_', ' ')} contact of stiffness {stiffness} (SI units); motion simulator "
        f"{rig['simulator']['model'].replace('_', ' ')}, delay "
        f"{_format_number(1e3 * rig['simulator'].get('delay', 0.0))} ms; force sensor delay "
        f"{_format_number(1e3 * rig['force_sensor'].get('delay', 0.0))} ms."
    )


def _error_table(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of errors on fresh scenarios."""
    robust = document["figures"].get("robust")
    rows = []
    for name, errors in robust.items() if isinstance(robust, Mapping) else ():
        if name in CURVE_LABELS and isinstance(errors, Mapping):
            cells = [
                *(errors.get(key) for key in (*ERROR_STATISTICS, "mean", "peak_ratio")),
                errors.get("failed"),
            ]
            rows.append((CURVE_LABELS[name], *(_format_number(value) for value in cells)))
    if rows:
        heads = (
            "fresh scenarios",
            *ERROR_STATISTICS.values(),
            "mean e - e*",
            "peak force / reference",
            "not ended",
        )
        yield from _html_table("What is reached: restitution error |e - e*| [1]", heads, rows)
    else:
        yield "<p>The gain file holds no figures of what the gains reach.</p>"


def _gain_table(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of gains."""
    rows = [
        (
            name,
            _format_number(gain.value, 6),
            gain.unit,
            f"{_format_number(gain.lower, 3)} to {_format_number(gain.upper, 3)}",
        )
        for name, gain in gain_entries(document).items()
    ]
    if rows:
        yield from _html_table("Gains", ("gain", "value", "unit", "bounds"), rows)
    else:
        yield "<h2>Gains</h2><p>None: the measured force is passed on.</p>"


def _limit_table(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of limits."""
    limits = _active_limits(document)
    if not limits:
        yield "<h2>Limits</h2><p>None in the gain file: those of the code hold.</p>"
        return
    rows = [
        (name, _format_number(limit.value, 5), limit.unit)
        for name, limit in limits.items()
        if is_user_limit(name)
    ]
    yield from _html_table("Limits", ("limit", "value", "unit"), rows, (1,))


def _watchdog_section(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the verdict on the watchdog, its alarm rates, and the limits that are not set."""
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
        yield f"<p>Its expected restitution: {fitted} fitted numbers in the gain file.</p>"
    unset = [name for name in document["limits"] if name not in limits]
    if unset:
        yield f'<p class="note">Limited by the code alone: {escape(", ".join(unset))}.</p>'


def _watchdog_verdict(rates: Mapping[str, Any]) -> str:
    """Return the verdict on the alarm rates, and the reasons against them."""
    texts = [text for key in ("reasons", "unknown") for text in rates.get(key, ()) if isinstance(text, str)]
    reasons = "; ".join(texts) or "wrong alarms are as rare as allowed"
    return to_one_line(f"{str(rates['verdict']).capitalize()}: {reasons}.", 500)


def _active_limits(document: Mapping[str, Any]) -> dict[str, GainOrLimit]:
    """Return the limits that have a value."""
    entries = limit_entries(document)
    return {name: entry for name, entry in entries.items() if document["limits"][name]["value"] is not None}


def is_user_limit(limit: str) -> bool:
    """Return whether a limit is meaningful to people; fitted numbers of the watchdog are not."""
    return not limit.startswith(FITTED_LIMIT_PREFIXES)


def describe_alarm_rates(rates: Mapping[str, Any]) -> Iterator[str]:
    """Yield texts on the rates of false and missed alarms, and on the errors that are noticed."""
    for name, runs in (("false_alarms", "good runs"), ("missed_alarms", "runs to be stopped")):
        rate = rates.get(name)
        if isinstance(rate, Mapping) and {"runs", "alarms", "low", "high"} <= rate.keys():
            allowed = f", limit {_format_number(rate['allowed'], 2)}" if "allowed" in rate else ""
            interval = f"95 %: {_format_number(rate['low'], 2)} to {_format_number(rate['high'], 2)}{allowed}"
            yield f"{name.replace('_', ' ')} {rate['alarms']} of {rate['runs']} {runs} ({interval})"
    for rate in rates.get("fault_runs", ()):
        if isinstance(rate, Mapping) and {"counted", "runs", "alarms", "low", "high", "error"} <= rate.keys():
            yield _describe_missed_faults(rate)
    noticed = rates.get("noticed_from")
    if isinstance(noticed, Mapping):
        yield from _describe_noticed_errors(noticed, rates)
    calibrated = rates.get("calibrated_on")
    if isinstance(calibrated, Mapping) and calibrated.get("runs") not in (None, "good"):
        yield "no run was good: the limits come from runs with errors beyond the limit"


def _describe_missed_faults(runs: Mapping[str, Any]) -> str:
    """Return a text on how often a fault of known size is missed."""
    unit = "" if runs["unit"] == "1" else f" {runs['unit']}"
    if not runs["counted"]:
        most = f"up to {_format_number(runs['largest_size'], 2)}{unit}"
        usable = f"{runs['runs']} of {runs['scenarios']} runs are good without it and just bad with it"
        return f"{runs['meaning']}, {most}: not counted, {usable}"
    interval = f"95 %: {_format_number(runs['low'], 2)} to {_format_number(runs['high'], 2)}"
    interval += f", limit {_format_number(runs['allowed'], 2)}"
    size = f"by {_format_number(runs['size'], 2)}{unit}, error {_format_number(runs['error'], 2)}"
    return (
        f"missed alarms {runs['alarms']} of {runs['runs']} runs with {runs['meaning']}, {size} ({interval})"
    )


def _describe_noticed_errors(noticed: Mapping[str, Any], rates: Mapping[str, Any]) -> Iterator[str]:
    """Yield texts on the smallest error that is noticed in 95 % of contacts."""
    if rates.get("widened_from") is not None:
        widened = (
            f"{_format_number(rates['widened_from'], 2)} to {_format_number(rates['restitution_margin'], 2)}"
        )
        yield f"restitution_margin widened from {widened}, or too many good runs would be stopped"
    if noticed.get("error") is not None:
        yield f"errors from {_format_number(noticed['error'], 2)} on are noticed in 95 % of contacts"
    elif noticed.get("largest") is not None:
        yield f"no error that occurred, up to {_format_number(noticed['largest'], 2)}, is noticed in 95 %"


def _html_table(
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


def _format_number(value: Any, digits: int = 4) -> str:
    """Return a number as text, or a dash if it is none."""
    return f"{value:.{digits}g}" if isinstance(value, (int, float)) else "-"


def _format_list(values: Any, most: int = 4) -> str:
    """Return numbers as text, at most `most` of them."""
    texts = [_format_number(value) for value in values]
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")


def _flatten(value: Any) -> Iterator[float]:
    """Yield the numbers of nested lists."""
    for entry in value:
        yield from _flatten(entry) if isinstance(entry, (list, tuple)) else (entry,)
