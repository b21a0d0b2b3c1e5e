"""Sections of a report on a rig's logs: identification of the rig, and monitoring of later contacts."""

import math

from jaxhil.errors import to_one_line
from tuning.identification.monitor.metrics import METRICS
from tuning.number_format import format_number
from tuning.reporting.documents import EstimateEntry, MonitoredMetric
from tuning.reporting.drawings import draw_estimates, monitor_drawing
from tuning.reporting.result_files import Results
from tuning.reporting.verdict_sections import (
    ReportTable,
    Section,
    is_identified,
    is_other_file_monitored,
)
from tuning.terminal import format_key

MAX_TABLE_ROWS = 60  # largest number of contacts in the table; earlier contacts are omitted


def identification_section(results: Results) -> Section | None:
    """Return the report's section on the identification of the rig, or None without an identification."""
    document = results.identification
    if document is None:
        return None
    rows = [
        (
            format_key(estimate.key),
            format_number(estimate.value, _significant_digits(estimate)),
            f"{format_number(estimate.low, _significant_digits(estimate))} to "
            f"{format_number(estimate.high, _significant_digits(estimate))}",
            estimate.unit,
            "given" if estimate.known else "logs",
        )
        for estimate in document.estimates
    ]
    checks = [
        (
            check.name,
            "yes" if check.there else "no",
            format_number((check.effect if check.there else 0.0) if check.counts else None, 3),
            check.finding,
        )
        for check in document.checks
    ]
    tables = [ReportTable(("parameter", "value", "95 %", "unit", "source"), rows)] if rows else []
    tables.append(ReportTable(("unmodelled effect", "detected", "effect on e", "finding"), checks, 9))
    texts = [document.reason + ".", *(f"{note[:1].upper()}{note[1:]}." for note in document.notes)]
    if results.subject is not None and not is_identified(results):
        texts.append(
            "The gains were tuned for other parameters than the identified ones: this identification does "
            "not support the gains."
        )
    drawings = [draw_estimates(document)] if rows else []
    return Section("identification", "Identification of the rig from its logs", texts, tables, drawings)


def monitoring_section(results: Results) -> Section | None:
    """Return the report's section on monitored contacts, or None without monitoring."""
    document = results.monitoring
    if document is None:
        return None
    headings = [f"{name} [{unit}]" if unit != "1" else name for name, unit, _ in METRICS]
    rows = [
        (
            f"{contact.contact}, {to_one_line(contact.log, 60)}",
            *(_format_metric(contact.figures.get(name), scale) for name, _, scale in METRICS),
            to_one_line(contact.state, 20),
        )
        for contact in document.contacts[-MAX_TABLE_ROWS:]
    ]
    texts = [
        f"{to_one_line(document.reason, 400)}.",
        f"The contacts are compared with {to_one_line(document.mechanism, 200)}; a metric is 0 on average if "
        "the rig matches this file.",
        *(f"{note[:1].upper()}{note[1:]}." for note in document.notes),
    ]
    if len(document.contacts) > MAX_TABLE_ROWS:
        texts.append(f"The table shows the last {MAX_TABLE_ROWS} of {len(document.contacts)} contacts.")
    if is_other_file_monitored(results):
        texts.append("The gains were tuned for another file: this monitoring does not support the gains.")
    table = ReportTable(("contact, log", *headings, "state"), rows)
    return Section("monitoring", "Monitoring of the rig", texts, [table], [monitor_drawing(document)])


def _significant_digits(estimate: EstimateEntry) -> int:
    """Return how many significant digits of an estimate to show, according to its standard deviation."""
    if (
        not estimate.std
        or not estimate.value
        or not math.isfinite(ratio := abs(estimate.value / estimate.std))
    ):
        return 4
    return min(max(2 + math.ceil(math.log10(ratio)), 3), 9) if ratio > 0 else 3


def _format_metric(metric: MonitoredMetric | None, scale: float) -> str:
    """Return `scale` times the value of a metric as text with its sign, or a dash if there is no value."""
    return format_number(None) if metric is None or metric.value is None else f"{scale * metric.value:+.2g}"
