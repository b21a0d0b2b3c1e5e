"""Report page for a review board: one self-contained HTML file, readable without JavaScript and on paper.

The template escapes all texts that come from files. The page's content security policy allows only the page's
own script, which magnifies plots.
"""

import base64
import hashlib
from collections.abc import Callable
from importlib import resources

import jinja2
from markupsafe import Markup

from tuning.reporting import rig_sections, study_sections, verdict_sections
from tuning.reporting.result_files import Results
from tuning.reporting.verdict_sections import Section

TEMPLATE, SCRIPT, STYLE = "page.html.jinja", "magnify.js", "page.css"
HEADLINES = {
    verdict_sections.GOOD: "Good: every requirement is met.",
    verdict_sections.BAD: "Bad: not every requirement is met.",
    verdict_sections.UNKNOWN: "Not decided: the given results do not show whether every requirement is met.",
}


def build_page(results: Results, say: Callable[[str], None] = lambda _: None) -> bytes:
    """Build the HTML page of the results, encoded as UTF-8; `say` is called with the name of each plot."""
    requirements = verdict_sections.collect_requirements(results)
    verdict = verdict_sections.combine_verdicts(requirements)
    summary, runs = study_sections.run_sections(results, say)
    sections: list[Section | None] = [
        verdict_sections.assumption_section(results),
        rig_sections.identification_section(results),
        rig_sections.monitoring_section(results),
        verdict_sections.gain_section(results),
        runs,
        study_sections.error_section(results),
        study_sections.sensitivity_section(results),
        study_sections.comparison_section(results),
        verdict_sections.watchdog_section(results),
        study_sections.map_section(results, say),
        study_sections.reproduction_section(results),
    ]
    script = _read_text(SCRIPT)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = environment.from_string(_read_text(TEMPLATE)).render(
        title=verdict_sections.report_title(results),
        verdict=verdict,
        headline=HEADLINES[verdict],
        requirements=requirements,
        summary=summary,
        sections=[section for section in sections if section is not None],
        style=Markup(_read_text(STYLE)),
        script=Markup(script),
        script_sha256=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        drawn=Markup,
    )
    return text.encode("utf-8")


def _read_text(name: str) -> str:
    """Return the text of a data file in this package."""
    return (resources.files("tuning.reporting") / name).read_text(encoding="utf-8")
