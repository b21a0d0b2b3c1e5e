"""Requirements and verdict of a report, and its sections on assumptions, gains and watchdog."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxhil.contact.laws import CONTACT_KEYS, find_contact_law, laws_with_key
from jaxhil.errors import to_one_line
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.number_ranges import numeric_keys, value_at
from jaxhil.mechanism.six_axes import numeric_keys_of
from jaxhil.mechanism.structs import Mechanism, Uncertainty
from jaxhil.mechanism.uncertainty import PHASE_KEY
from jaxhil.simulation.contact_plot import CURVE_LABELS
from tuning.bundle.summary import describe_alarm_rates, describe_limit, is_user_limit
from tuning.bundle.writers import gain_entries, limit_entries
from tuning.number_format import format_number
from tuning.reporting.drawings import ScenarioPlot, SvgPlot
from tuning.reporting.result_files import Results
from tuning.sweeps.columns import find_key_unit

GOOD, BAD, UNKNOWN = "good", "bad", "unknown"
UNKNOWN_NAME = "(not known)"
FILE_PRECISION = 1e-11  # relative precision of numbers in an identified mechanism file, with 12 digits [1]


@dataclass(frozen=True)
class ReportTable:
    """Table of a report."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: int = 1  # index of the first column with numbers; all later columns contain numbers too


@dataclass(frozen=True)
class Section:
    """Section of the report page: paragraphs, tables, plots and commands."""

    name: str  # anchor in the page
    title: str
    texts: Sequence[str] = ()  # paragraphs
    tables: Sequence[ReportTable] = ()
    drawings: Sequence[SvgPlot] = ()
    traces: Sequence[ScenarioPlot] = ()  # runs of scenarios; the page shows one at a time
    lines: Sequence[str] = field(default=())  # commands as typed in a shell


@dataclass(frozen=True)
class Requirement:
    """Requirement on the results, with the value reached, the margin and the verdict, as texts."""

    what: str  # quantity that must meet the requirement
    required: str  # allowed values
    result: str  # value reached
    margin: str  # distance between the result and the end of the allowed values
    verdict: str  # good, bad or unknown


def collect_requirements(results: Results) -> list[Requirement]:
    """Return the requirements for all given results, with the verdict on each requirement."""
    rig_requirements = (*_identification_requirement(results), *_monitoring_requirement(results))
    return [*_sweep_requirement(results), *_watchdog_requirements(results), *rig_requirements]


def combine_verdicts(items: Sequence[Requirement]) -> str:
    """Return the report's verdict: bad if any requirement is bad, good if all are good, else unknown."""
    verdicts = {requirement.verdict for requirement in items}
    if BAD in verdicts:
        return BAD
    return GOOD if verdicts == {GOOD} else UNKNOWN


def assumption_section(results: Results) -> Section | None:
    """Return the report's section with each parameter of the mechanism, its uncertainty and its origin."""
    subject = results.subject
    if subject is None:
        return None
    mechanism, origins = subject.mechanism, _identified_origins(results)
    latency = mechanism.rig.command_latency
    unused = _unused_keys(mechanism)
    rows = []
    for path in numeric_keys_of(mechanism):
        if path.startswith("uncertainty"):
            continue
        value = value_at(mechanism, path)
        if value is None or value == [] or np.all(np.isinf(value)) or path in unused:
            continue
        unit = find_key_unit(mechanism, path)
        uncertain = mechanism.uncertainty.get(path)
        varies = "fixed"
        if path == PHASE_KEY:
            varies = "uniform, 0 to 1" + ("" if results.axes == 6 else ", drawn for each contact")
        varies = varies if uncertain is None else _describe_distribution(uncertain, unit)
        rows.append((path, _format_value(value), unit, varies, origins.get(path, "the file")))
    texts = [
        f"{_describe_contact_laws(mechanism)}; motion simulator: {mechanism.rig.simulator.model}"
        f"{_describe_six_axis_rig(mechanism)}; "
        f"integrator: {mechanism.rig.integrator}; command hold: {mechanism.rig.command_hold}; "
        f"command latency: {latency} {'period' if latency == 1 else 'periods'}{_describe_filter(mechanism)}.",
        f"Source of the file: {to_one_line(mechanism.source, 1000) or UNKNOWN_NAME}",
    ]
    if mechanism.correlation is not None:
        texts.append("Some of these parameters are correlated, as [correlation] in the file states.")
    headings = ("key", "value", "unit", "variation", "source")
    return Section("assumptions", "Assumptions and their sources", texts, [ReportTable(headings, rows, 9)])


def _unused_keys(mechanism: AnyMechanism) -> list[str]:
    """Return the keys of [contact] that the law of a one-axis mechanism does not use, but other laws do."""
    if not isinstance(mechanism, Mechanism):
        return []
    law = find_contact_law(mechanism.contact.law)
    keys = CONTACT_KEYS.values() if law.keys is not None else ()
    return [f"contact.{key.name}" for key in keys if law.name not in laws_with_key(key)]


def _describe_six_axis_rig(mechanism: AnyMechanism) -> str:
    """Return a text with the simulator's axes and the sensor's side in six axes; empty for one axis."""
    if isinstance(mechanism, Mechanism):
        return ""
    return f", axes: {mechanism.rig.simulator.space}; side of the sensor: {mechanism.rig.force_sensor.side}"


def _describe_filter(mechanism: AnyMechanism) -> str:
    """Return a text with kind and order of the force sensor's filter, or an empty text without a filter."""
    sensor_filter = mechanism.rig.force_sensor.filter
    return (
        f"; filter of the force: {sensor_filter.kind} of order {sensor_filter.order}" if sensor_filter else ""
    )


def _describe_contact_laws(mechanism: AnyMechanism) -> str:
    """Return a text with the contact law, or the contact laws, of a mechanism."""
    if isinstance(mechanism, Mechanism):
        return f"Contact law: {mechanism.contact.law}"
    laws = (f"{name} {contact.law}" for name, contact in mechanism.contact.items())
    return f"Contact laws: {', '.join(laws) or 'none'}"


def gain_section(results: Results) -> Section | None:
    """Return the report's section on the gains: values, bounds, resulting errors, and controller's limits."""
    subject = results.subject
    if subject is None:
        return None
    document = subject.document
    rows = [
        (
            name,
            format_number(gain.value, 6),
            gain.unit,
            f"{format_number(gain.lower, 4)} to {format_number(gain.upper, 4)}",
        )
        for name, gain in gain_entries(document).items()
    ]
    tables = [ReportTable(("gain", "value", "unit", "bounds"), rows)] if rows else []
    limits = [
        (name, *describe_limit(document["limits"][name]["value"], limit.unit))
        for name, limit in limit_entries(document).items()
        if is_user_limit(name)
    ]
    tables += [ReportTable(("limit on the rig", "value", "unit"), limits)] if limits else []
    headings = ("rms", "99th percentile", "largest", "mean e - e*", "peak command / ideal peak force")
    if results.axes == 6:
        headings = (*headings[:3], "mean", headings[4])
        errors = {"energy error": "energy_error", "twist error": "twist_error"}
    else:
        errors = {"error |e - e*|": "robust"}
    for name, key in errors.items():
        error_rows = list(_error_rows(document.get("figures"), key))
        tables += [ReportTable((f"{name} on fresh scenarios", *headings), error_rows)] if error_rows else []
    texts = () if rows else (f"{subject.compensator} has no gains.",)
    return Section("gains", f"Gains of {subject.compensator}", texts, tables)


def _sweep_requirement(results: Results) -> Iterator[Requirement]:
    """Yield the requirement on the failure probability of a sweep, if there is a sweep."""
    sweep = results.sweep
    if sweep is None:
        return
    limit = "" if sweep.limit is None else f" with {results.error} beyond {sweep.limit:g}, or"
    what = f"scenarios{limit} that do not end well"
    share = sweep.failure_probability
    result = (
        f"{sweep.failed} of {sweep.scenarios}: {share.value:.4g} (95 %: {share.low:.3g} to {share.high:.3g})"
    )
    if sweep.acceptable is None:
        required, margin = "none", f"{sweep.failed} too many"
        if sweep.failed == 0:
            margin = _error_margin(sweep.limit, sweep.worst[0].worst_error if sweep.worst else None)
    else:
        required = f"95 % interval ends at or below {sweep.acceptable:g}"
        margin = f"{sweep.acceptable - share.high:+.3g}"
    yield Requirement(what, required, result, margin, _as_verdict(sweep.verdict))


def _error_margin(limit: float | None, largest: float | None) -> str:
    """Return a text with a sweep's error limit minus the largest error; "none" if a value is missing."""
    if limit is None or largest is None:
        return "none"
    return f"{limit - abs(largest):+.2g} of the error"


def _watchdog_requirements(results: Results) -> Iterator[Requirement]:
    """Yield the requirements on false and missed alarms of the watchdog, if a bundle states their rates."""
    rates = watchdog_rates(results)
    faulty = [
        rate for rate in rates.get("fault_runs", ()) if isinstance(rate, Mapping) and rate.get("counted")
    ]
    kinds = [(rates.get("false_alarms"), "good runs that the watchdog stops")]
    kinds += [(rate, f"bad runs that the watchdog misses, with {rate.get('meaning')}") for rate in faulty]
    drawn = rates.get("missed_alarms")
    # If faults were injected, the missed alarms of drawn runs count only if their rate is certainly too high.
    if not faulty or (isinstance(drawn, Mapping) and drawn.get("low", 0) > drawn.get("allowed", 1)):
        kinds.append((drawn, "bad runs that the watchdog misses"))
    for rate, what in kinds:
        if not isinstance(rate, Mapping) or not isinstance(rate.get("allowed"), (int, float)):
            continue
        low, high, allowed = rate.get("low"), rate.get("high"), rate["allowed"]
        interval = f"95 %: {format_number(low, 2)} to {format_number(high, 2)}"
        result = f"{rate.get('alarms')} of {rate.get('runs')} ({interval})"
        has_interval = isinstance(high, (int, float)) and isinstance(low, (int, float))
        verdict = (
            UNKNOWN if not has_interval else GOOD if high <= allowed else BAD if low > allowed else UNKNOWN
        )
        margin = format_number(allowed - high if has_interval else None, 2)
        yield Requirement(what, f"at most {allowed:g}", result, margin, verdict)


def _identification_requirement(results: Results) -> Iterator[Requirement]:
    """Yield the requirement on the change of the restitution e by the identified model's uncertainty."""
    document = results.identification
    if document is not None:
        effects = [value for value in (document.effect, document.effect_on_error) if value is not None]
        effect, limit = max(effects, default=None), document.limit
        margin = format_number(None if effect is None or limit is None else limit - effect, 3)
        what = "change of e or e - e* by unexplained effects and uncertainty of the identified model"
        # An identification cannot support gains that were tuned for another mechanism.
        is_other_mechanism = results.subject is not None and not is_identified(results)
        verdict = UNKNOWN if is_other_mechanism else _as_verdict(document.verdict)
        yield Requirement(what, f"below {format_number(limit)}", format_number(effect), margin, verdict)


def _monitoring_requirement(results: Results) -> Iterator[Requirement]:
    """Yield the requirement that the rig still matches the mechanism file, if the rig was monitored."""
    document = results.monitoring
    if document is not None:
        since = "in all" if document.since is None else f"since contact {document.since}"
        result = f"{to_one_line(document.state, 20)} {since} of {len(document.contacts)} contacts"
        verdict = BAD if document.state == "bad" else GOOD if document.state in (GOOD, "watch") else UNKNOWN
        verdict = UNKNOWN if is_other_file_monitored(results) else verdict
        what = "change of the rig since its mechanism file was identified"
        yield Requirement(what, "within the file's uncertainty", result, format_number(None), verdict)


def is_other_file_monitored(results: Results) -> bool:
    """Return whether the mechanism file used for monitoring differs from the file used to tune the gains."""
    monitoring, subject = results.monitoring, results.subject
    if monitoring is None or subject is None:
        return False
    return monitoring.mechanism_sha256 != subject.document.get("mechanism_sha256")


def watchdog_rates(results: Results) -> Mapping[str, Any]:
    """Return the watchdog's alarm rates in the bundle's gain file; an empty dictionary if there are none."""
    metrics = {} if results.bundle is None else results.bundle.document.get("figures")
    rates = metrics.get("watchdog") if isinstance(metrics, Mapping) else None
    return rates if isinstance(rates, Mapping) else {}


def watchdog_section(results: Results) -> Section | None:
    """Return the report's section on the watchdog's alarm rates, or None if there are none."""
    rates = watchdog_rates(results)
    texts = [f"{text[:1].upper()}{text[1:]}." for text in describe_alarm_rates(rates)]
    return Section("watchdog", "The watchdog", texts) if texts else None


def _as_verdict(verdict: str) -> str:
    """Return the given verdict if it is good or bad, else unknown."""
    return verdict if verdict in (GOOD, BAD) else UNKNOWN


def _error_rows(metrics: Any, key: str) -> Iterator[tuple[str, ...]]:
    """Yield for each set of gains a table row with its errors in scenarios that were not used for tuning.

    `metrics` is the entry "figures" of a gain file, and `key` the kind of error in it.
    """
    by_gains = metrics.get(key) if isinstance(metrics, Mapping) else None
    # The intervals are for all errors together; six axes have no intervals for each kind of error.
    intervals = metrics.get("tuned_intervals") if isinstance(metrics, Mapping) and key == "robust" else None
    for name, errors in by_gains.items() if isinstance(by_gains, Mapping) else ():
        if name not in CURVE_LABELS or not isinstance(errors, Mapping):
            continue
        cells = []
        for key in ("rms", "p99", "max", "mean", "peak_ratio"):
            text, span = format_number(errors.get(key)), None
            if name == "tuned" and isinstance(intervals, Mapping):
                span = intervals.get(key)
            if isinstance(span, Mapping):
                text += f" ({format_interval(span.get('low'), span.get('high'))})"
            cells.append(text)
        yield (CURVE_LABELS[name], *cells)


def _identified_origins(results: Results) -> dict[str, str]:
    """Return, by key, the source of each identified value as text: estimated from logs, or kept fixed."""
    document = results.identification
    if document is None or not is_identified(results):
        return {}
    origins = {}
    for estimate in document.estimates:
        path, _, index = estimate.key.rpartition(".")
        key = path if index.isdigit() else estimate.key
        text = "fixed in the identification"
        if not estimate.known:
            text = f"logs, 95 %: {format_interval(estimate.low, estimate.high)}"
        origins[key] = text if key not in origins else f"{origins[key]}; {text}"
    return origins


def is_identified(results: Results) -> bool:
    """Return whether the gain file's mechanism has the parameter values that `jaxhil identify` wrote."""
    subject, raw = results.subject, results.identified
    if subject is None:
        return False
    for path in numeric_keys():
        value: Any = raw
        for part in path.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if value is not None and not path.startswith("uncertainty"):
            nominal = value_at(subject.mechanism, path)
            try:
                if not np.allclose(
                    np.asarray(nominal, float), np.asarray(value, float), rtol=FILE_PRECISION, atol=0.0
                ):
                    return False
            except (TypeError, ValueError):
                return False
    return True


def _describe_distribution(uncertain: Uncertainty, unit: str) -> str:
    """Return a text that describes the distribution of a parameter."""
    if uncertain.std is not None:
        text = f"normal, standard deviation {uncertain.std:.4g} {unit}"
    elif uncertain.factor is not None:
        low, high = uncertain.factor
        text = f"{uncertain.distribution}, {low:g} to {high:g} times"
    else:
        low, high = format_number(uncertain.low), format_number(uncertain.high)
        text = f"{uncertain.distribution}, {low} to {high} {unit}"
    return text + (", drawn for each entry" if uncertain.independent else "")


def _format_value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        entries = [_format_value(entry) for entry in value[:8]]
        return ", ".join(entries) + (f", ... ({len(value)} in all)" if len(value) > len(entries) else "")
    return format_number(value, 6)


def format_interval(low: Any, high: Any) -> str:
    """Return an interval as the text "LOW to HIGH"."""
    return f"{format_number(low)} to {format_number(high)}"


def report_title(results: Results) -> str:
    """Return the title of the report: the mechanism's name and, if known, the compensator's name."""
    subject = results.subject
    if subject is not None:
        return f"{to_one_line(subject.mechanism.name, 80)}: {subject.compensator}"
    if results.map is not None:
        return f"{to_one_line(results.map.mechanism, 80)}: {to_one_line(results.map.compensator, 40)}"
    names = [entry.mechanism for entry in results.comparison.mechanisms] if results.comparison else []
    if not names and not results.identified and results.monitoring is not None:
        names = [results.monitoring.mechanism]
    return to_one_line(", ".join(names), 80) or _identified_name(results.identified)


def _identified_name(raw: Mapping[str, Any]) -> str:
    """Return the name in a mechanism file written by `jaxhil identify`; `raw` is the file's content."""
    name = raw.get("name")
    return to_one_line(name, 80) if isinstance(name, str) else "an identification"
