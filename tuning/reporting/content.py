"""What a report says: the verdict, what it rests on, what is known of the gains, in sections of tables."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxhil.errors import one_line
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import numeric_keys_of
from jaxhil.mechanism.structs import Mechanism, Uncertainty, numeric_keys, value_at
from jaxhil.mechanism.uncertainty import PHASE
from jaxhil.simulation.contact_plot import LABELS
from tuning.bundle.summary import alarm_rates, is_shown
from tuning.bundle.writers import gain_entries, limit_entries
from tuning.reporting.drawings import Drawing, Trace
from tuning.reporting.reading import Results
from tuning.sweeps.columns import unit_of

GOOD, BAD, UNKNOWN = "good", "bad", "unknown"
OTHER = "(not known)"


@dataclass(frozen=True)
class Table:
    """A table; columns from `numbers` on hold numbers."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: int = 1


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    name: str  # of its place in the page
    title: str
    texts: Sequence[str] = ()
    tables: Sequence[Table] = ()
    drawings: Sequence[Drawing] = ()
    traces: Sequence[Trace] = ()
    lines: Sequence[str] = field(default=())  # commands, as typed


@dataclass(frozen=True)
class Requirement:
    """What is asked for, and what was found."""

    what: str
    required: str
    result: str
    margin: str
    verdict: str  # good, bad or unknown


def requirements(results: Results) -> list[Requirement]:
    """What the results themselves were judged by."""
    of_rig = (*_of_identification(results), *_of_monitoring(results))
    return [*_of_sweep(results), *_of_watchdog(results), *of_rig]


def verdict_of(found: Sequence[Requirement]) -> str:
    """Bad if any is, else unknown if any is or there is none, else good."""
    verdicts = {one.verdict for one in found}
    if BAD in verdicts:
        return BAD
    return GOOD if verdicts == {GOOD} else UNKNOWN


def assumptions(results: Results) -> Section | None:
    """Every number of the mechanism, its uncertainty, and how it is known."""
    subject = results.subject
    if subject is None:
        return None
    mechanism, known = subject.mechanism, _identified(results)
    rows = []
    keys = numeric_keys_of(mechanism) if results.axes == 6 else numeric_keys()
    for path, allowed in keys.items():
        if path.startswith("uncertainty"):
            continue
        value = value_at(mechanism, path)
        if value is None or value == [] or np.all(np.isinf(value)):
            continue
        unit = unit_of(mechanism, path) or allowed.unit
        uncertain = mechanism.uncertainty.get(path)
        varies = "fixed"
        if path == PHASE:
            varies = "uniform, 0 to 1" + ("" if results.axes == 6 else ", each contact its own")
        varies = varies if uncertain is None else _drawn(uncertain, unit)
        rows.append((path, _value(value), unit, varies, known.get(path, "the file")))
    texts = [
        f"{_laws(mechanism)}; motion simulator: {mechanism.rig.simulator.model}; "
        f"integrator: {mechanism.rig.integrator}; command hold: {mechanism.rig.command_hold}.",
        f"Source of the file: {one_line(mechanism.source, 1000) or OTHER}",
    ]
    if mechanism.correlation is not None:
        texts.append("Some of these numbers vary together, as the file's [correlation] says.")
    heads = ("key", "value", "unit", "varies", "known from")
    return Section("assumptions", "What is assumed, and how it is known", texts, [Table(heads, rows, 9)])


def _laws(mechanism: AnyMechanism) -> str:
    if isinstance(mechanism, Mechanism):
        return f"Law of the contact: {mechanism.contact.law}"
    laws = (f"{name} {contact.law}" for name, contact in mechanism.contact.items())
    return f"Laws of the contacts: {', '.join(laws) or 'none'}"


def gains(results: Results) -> Section | None:
    """Gains with their bounds, limits of the rig, what they reach on fresh scenarios."""
    subject = results.subject
    if subject is None:
        return None
    document = subject.document
    rows = [
        (name, number(one.value, 6), one.unit, f"{number(one.lower, 4)} to {number(one.upper, 4)}")
        for name, one in gain_entries(document).items()
    ]
    tables = [Table(("gain", "value", "unit", "bounds"), rows)] if rows else []
    shown = [
        (name, number(one.value, 5), one.unit)
        for name, one in limit_entries(document).items()
        if is_shown(name)
    ]
    tables += [Table(("limit on the rig", "value", "unit"), shown)] if shown else []
    keys = ("rms", "99th percentile", "largest", "mean e - e*", "peak / reference")
    if results.axes == 6:
        keys = (*keys[:3], "mean", keys[4])
        judged = {"energy error": "energy_error", "twist error": "twist_error"}
    else:
        judged = {"error |e - e*|": "robust"}
    for name, key in judged.items():
        reached = list(_reached(document.get("figures"), key))
        tables += [Table((f"{name} on fresh scenarios", *keys), reached)] if reached else []
    return Section("gains", f"Gains of {subject.compensator}", () if rows else ("It has none.",), tables)


def number(value: Any, digits: int = 4) -> str:
    """A number in so many digits; a dash for what is none, or not finite."""
    known = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return f"{value:.{digits}g}" if known else "–"  # noqa: RUF001


def _of_sweep(results: Results) -> Iterator[Requirement]:
    found = results.sweep
    if found is None:
        return
    limit = "" if found.limit is None else f" with {results.error} beyond {found.limit:g}, or"
    what = f"scenarios{limit} that do not end well"
    share = found.failure_probability
    result = (
        f"{found.failed} of {found.scenarios}: {share.value:.4g} (95 %: {share.low:.3g} to {share.high:.3g})"
    )
    if found.acceptable is None:
        required, margin = "none", f"{found.failed} too many"
        if found.failed == 0:
            margin = _error_margin(found.limit, found.worst[0].worst_error if found.worst else None)
    else:
        required = f"95 % interval ends at or below {found.acceptable:g}"
        margin = f"{found.acceptable - share.high:+.3g}"
    yield Requirement(what, required, result, margin, _known(found.verdict))


def _error_margin(limit: float | None, largest: float | None) -> str:
    """Return how far the largest error of a sweep stays below its limit."""
    if limit is None or largest is None:
        return "none"
    return f"{limit - abs(largest):+.2g} of the error"


def _of_watchdog(results: Results) -> Iterator[Requirement]:
    rates = watchdog_rates(results)
    faulty = [one for one in rates.get("fault_runs", ()) if isinstance(one, Mapping) and one.get("counted")]
    kinds = [(rates.get("false_alarms"), "good runs that the watchdog stops")]
    kinds += [(one, f"bad runs that it misses, with {one.get('meaning')}") for one in faulty]
    drawn = rates.get("missed_alarms")
    # What was drawn says little of missed alarms where faults were injected, unless it is bad.
    if not faulty or (isinstance(drawn, Mapping) and drawn.get("low", 0) > drawn.get("allowed", 1)):
        kinds.append((drawn, "bad runs that it misses"))
    for one, what in kinds:
        if not isinstance(one, Mapping) or not isinstance(one.get("allowed"), (int, float)):
            continue
        low, high, allowed = one.get("low"), one.get("high"), one["allowed"]
        result = f"{one.get('alarms')} of {one.get('runs')} (95 %: {number(low, 2)} to {number(high, 2)})"
        known = isinstance(high, (int, float)) and isinstance(low, (int, float))
        verdict = UNKNOWN if not known else GOOD if high <= allowed else BAD if low > allowed else UNKNOWN
        margin = number(allowed - high if known else None, 2)
        yield Requirement(what, f"at most {allowed:g}", result, margin, verdict)


def _of_identification(results: Results) -> Iterator[Requirement]:
    found = results.identification
    if found is not None:
        effects = [one for one in (found.effect, found.effect_on_error) if one is not None]
        effect, limit = max(effects, default=None), found.limit
        margin = number(None if effect is None or limit is None else limit - effect, 3)
        what = "change of e or e - e* by what the identified model leaves unexplained or uncertain"
        # What was identified says nothing of gains that were tuned for something else.
        elsewhere = results.subject is not None and not is_identified(results)
        verdict = UNKNOWN if elsewhere else _known(found.verdict)
        yield Requirement(what, f"below {number(limit)}", number(effect), margin, verdict)


def _of_monitoring(results: Results) -> Iterator[Requirement]:
    found = results.monitoring
    if found is not None:
        since = "in all" if found.since is None else f"since contact {found.since}"
        result = f"{one_line(found.state, 20)} {since} of {len(found.contacts)} contacts"
        verdict = BAD if found.state == "bad" else GOOD if found.state in (GOOD, "watch") else UNKNOWN
        verdict = UNKNOWN if is_of_another_file(results) else verdict
        what = "whether the rig still is that of the mechanism file"
        yield Requirement(what, "within the file's uncertainty", result, number(None), verdict)


def is_of_another_file(results: Results) -> bool:
    """Whether the contacts that were monitored were held against another file than the gains' own."""
    found, subject = results.monitoring, results.subject
    if found is None or subject is None:
        return False
    return found.mechanism_sha256 != subject.document.get("mechanism_sha256")


def watchdog_rates(results: Results) -> Mapping[str, Any]:
    """What is known of the watchdog's alarms; nothing without a bundle."""
    figures = {} if results.bundle is None else results.bundle.document.get("figures")
    rates = figures.get("watchdog") if isinstance(figures, Mapping) else None
    return rates if isinstance(rates, Mapping) else {}


def watchdog(results: Results) -> Section | None:
    """How often the watchdog errs."""
    rates = watchdog_rates(results)
    texts = [f"{text[:1].upper()}{text[1:]}." for text in alarm_rates(rates)]
    return Section("watchdog", "The watchdog", texts) if texts else None


def _known(verdict: str) -> str:
    return verdict if verdict in (GOOD, BAD) else UNKNOWN


def _reached(figures: Any, key: str) -> Iterator[tuple[str, ...]]:
    robust = figures.get(key) if isinstance(figures, Mapping) else None
    # They are those of all errors together.
    intervals = figures.get("tuned_intervals") if isinstance(figures, Mapping) and key == "robust" else None
    for name, one in robust.items() if isinstance(robust, Mapping) else ():
        if name not in LABELS or not isinstance(one, Mapping):
            continue
        cells = []
        for key in ("rms", "p99", "max", "mean", "peak_ratio"):
            text, span = number(one.get(key)), None
            if name == "tuned" and isinstance(intervals, Mapping):
                span = intervals.get(key)
            if isinstance(span, Mapping):
                text += f" ({interval(span.get('low'), span.get('high'))})"
            cells.append(text)
        yield (LABELS[name], *cells)


def _identified(results: Results) -> dict[str, str]:
    """How each key is known, where an identification says so."""
    found = results.identification
    if found is None or not is_identified(results):
        return {}
    said = {}
    for one in found.estimates:
        path, _, place = one.key.rpartition(".")
        key = path if place.isdigit() else one.key
        text = "given to the identification"
        if not one.known:
            text = f"the logs, 95 %: {interval(one.low, one.high)}"
        said[key] = text if key not in said else f"{said[key]}; {text}"
    return said


def is_identified(results: Results) -> bool:
    """Whether the mechanism of the gains is the one that was identified, in its own numbers."""
    subject, raw = results.subject, results.identified
    if subject is None:
        return False
    for path in numeric_keys():
        value: Any = raw
        for part in path.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if value is not None and not path.startswith("uncertainty"):
            own = value_at(subject.mechanism, path)
            try:
                if not np.array_equal(np.asarray(own, float), np.asarray(value, float)):
                    return False
            except (TypeError, ValueError):
                return False
    return True


def _drawn(uncertain: Uncertainty, unit: str) -> str:
    """A distribution in words."""
    if uncertain.std is not None:
        text = f"normal, standard deviation {uncertain.std:.4g} {unit}"
    elif uncertain.factor is not None:
        low, high = uncertain.factor
        text = f"{uncertain.distribution}, {low:g} to {high:g} times"
    else:
        text = f"{uncertain.distribution}, {number(uncertain.low)} to {number(uncertain.high)} {unit}"
    return text + (", each entry its own" if uncertain.independent else "")


def _value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        shown = [_value(one) for one in value[:8]]
        return ", ".join(shown) + (f", ... ({len(value)} in all)" if len(value) > len(shown) else "")
    return number(value, 6)


def interval(low: Any, high: Any) -> str:
    return f"{number(low)} to {number(high)}"


def title_of(results: Results) -> str:
    """What the report is about."""
    subject = results.subject
    if subject is not None:
        return f"{one_line(subject.mechanism.name, 80)}: {subject.compensator}"
    if results.map is not None:
        return f"{one_line(results.map.mechanism, 80)}: {one_line(results.map.compensator, 40)}"
    names = [one.mechanism for one in results.comparison.mechanisms] if results.comparison else []
    if not names and not results.identified and results.monitoring is not None:
        names = [results.monitoring.mechanism]
    return one_line(", ".join(names), 80) or _name_of(results.identified)


def _name_of(raw: Mapping[str, Any]) -> str:
    name = raw.get("name")
    return one_line(name, 80) if isinstance(name, str) else "an identification"
