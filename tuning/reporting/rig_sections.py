"""Sections of a report from a rig's logs: the identification, and the monitoring of later contacts."""

import math

from jaxhil.errors import one_line
from tuning.identification.monitor.figures import FIGURES
from tuning.reporting.content import Section, Table, is_identified, is_of_another_file, number
from tuning.reporting.documents import Estimate, MonitoredFigure
from tuning.reporting.drawings import estimates_drawing, monitor_drawing
from tuning.reporting.reading import Results

MOST_ROWS = 60  # largest number of contacts in the table


def identification(results: Results) -> Section | None:
    """Return the section on the identification of the rig."""
    document = results.identification
    if document is None:
        return None
    rows = [
        (
            estimate.key,
            number(estimate.value, _digits(estimate)),
            f"{number(estimate.low, _digits(estimate))} to {number(estimate.high, _digits(estimate))}",
            estimate.unit,
            "given" if estimate.known else "logs",
        )
        for estimate in document.estimates
    ]
    checks = [
        (
            check.name,
            "yes" if check.there else "no",
            number((check.effect if check.there else 0.0) if check.counts else None, 3),
            check.finding,
        )
        for check in document.checks
    ]
    tables = [Table(("number", "value", "95 %", "unit", "from"), rows)] if rows else []
    tables.append(Table(("what the model may lack", "there", "effect on e", "finding"), checks, 9))
    texts = [document.reason + ".", *(f"{note[:1].upper()}{note[1:]}." for note in document.notes)]
    if results.subject is not None and not is_identified(results):
        texts.append(
            "The gains were tuned for other numbers than those identified: this says nothing of them."
        )
    drawings = [estimates_drawing(document)] if rows else []
    return Section("identification", "From the rig's logs", texts, tables, drawings)


def monitoring(results: Results) -> Section | None:
    """Return the section on contacts of later logs, compared with the mechanism file."""
    document = results.monitoring
    if document is None:
        return None
    heads = [f"{name} [{unit}]" if unit != "1" else name for name, unit, _ in FIGURES]
    rows = [
        (
            f"{contact.contact}, {one_line(contact.log, 60)}",
            *(_shown(contact.figures.get(name), scale) for name, _, scale in FIGURES),
            one_line(contact.state, 20),
        )
        for contact in document.contacts[-MOST_ROWS:]
    ]
    texts = [
        f"{one_line(document.reason, 400)}.",
        f"Held against {one_line(document.mechanism, 200)}; a figure is 0 where the rig is that of the file.",
        *(f"{note[:1].upper()}{note[1:]}." for note in document.notes),
    ]
    if len(document.contacts) > MOST_ROWS:
        texts.append(f"Of {len(document.contacts)} contacts the table has the last {MOST_ROWS}.")
    if is_of_another_file(results):
        texts.append("The gains were tuned for another file: this says nothing of them.")
    table = Table(("contact, log", *heads, "state"), rows)
    return Section("monitoring", "The rig since", texts, [table], [monitor_drawing(document)])


def _digits(estimate: Estimate) -> int:
    """Return the number of digits that an estimate's uncertainty supports, plus one."""
    if (
        not estimate.std
        or not estimate.value
        or not math.isfinite(ratio := abs(estimate.value / estimate.std))
    ):
        return 4
    return min(max(2 + math.ceil(math.log10(ratio)), 3), 9) if ratio > 0 else 3


def _shown(metric: MonitoredFigure | None, scale: float) -> str:
    """Return a scaled metric as text, or a dash."""
    return number(None) if metric is None or metric.value is None else f"{scale * metric.value:+.2g}"
