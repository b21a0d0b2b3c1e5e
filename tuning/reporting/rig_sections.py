"""What a rig's own logs say, in sections: what was identified of them, and whether the rig still is that."""

import math

from jaxhil.errors import one_line
from tuning.identification.monitor.figures import FIGURES
from tuning.reporting.content import Section, Table, is_identified, is_of_another_file, number
from tuning.reporting.documents import Estimate, MonitoredFigure
from tuning.reporting.drawings import estimates_drawing
from tuning.reporting.monitor_drawing import monitor_drawing
from tuning.reporting.reading import Results

MOST_ROWS = 60  # contacts in the table


def identification(results: Results) -> Section | None:
    """What was identified of the rig's logs."""
    found = results.identification
    if found is None:
        return None
    rows = [
        (
            one.key,
            number(one.value, _digits(one)),
            f"{number(one.low, _digits(one))} to {number(one.high, _digits(one))}",
            one.unit,
            "given" if one.known else "logs",
        )
        for one in found.estimates
    ]
    checks = [
        (
            one.name,
            "yes" if one.there else "no",
            number((one.effect if one.there else 0.0) if one.counts else None, 3),
            one.finding,
        )
        for one in found.checks
    ]
    tables = [Table(("number", "value", "95 %", "unit", "from"), rows)] if rows else []
    tables.append(Table(("what the model may lack", "there", "effect on e", "finding"), checks, 9))
    texts = [found.reason + ".", *(f"{note[:1].upper()}{note[1:]}." for note in found.notes)]
    if results.subject is not None and not is_identified(results):
        texts.append(
            "The gains were tuned for other numbers than those identified: this says nothing of them."
        )
    drawings = [estimates_drawing(found)] if rows else []
    return Section("identification", "From the rig's logs", texts, tables, drawings)


def monitoring(results: Results) -> Section | None:
    """Contacts of later logs, held against the mechanism file."""
    found = results.monitoring
    if found is None:
        return None
    heads = [f"{name} [{unit}]" if unit != "1" else name for name, unit, _ in FIGURES]
    rows = [
        (
            f"{one.contact}, {one_line(one.log, 60)}",
            *(_shown(one.figures.get(name), scale) for name, _, scale in FIGURES),
            one_line(one.state, 20),
        )
        for one in found.contacts[-MOST_ROWS:]
    ]
    texts = [
        f"{one_line(found.reason, 400)}.",
        f"Held against {one_line(found.mechanism, 200)}; a figure is 0 where the rig is that of the file.",
        *(f"{note[:1].upper()}{note[1:]}." for note in found.notes),
    ]
    if len(found.contacts) > MOST_ROWS:
        texts.append(f"Of {len(found.contacts)} contacts the table has the last {MOST_ROWS}.")
    if is_of_another_file(results):
        texts.append("The gains were tuned for another file: this says nothing of them.")
    table = Table(("contact, log", *heads, "state"), rows)
    return Section("monitoring", "The rig since", texts, [table], [monitor_drawing(found)])


def _digits(one: Estimate) -> int:
    """As many as it is known to, and one more."""
    if not one.std or not one.value or not math.isfinite(ratio := abs(one.value / one.std)):
        return 4
    return min(max(2 + math.ceil(math.log10(ratio)), 3), 9) if ratio > 0 else 3


def _shown(one: MonitoredFigure | None, scale: float) -> str:
    return number(None) if one is None or one.value is None else f"{scale * one.value:+.2g}"
