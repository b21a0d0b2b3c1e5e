"""Report page for a review board: one self-contained HTML file, readable without JavaScript and on paper.

The template escapes every text from a file, and the page's content security policy allows only its own
script, which magnifies plots.
"""

import base64
import hashlib
from collections.abc import Callable
from importlib import resources

import jinja2
from markupsafe import Markup

from tuning.reporting import content, rig_sections, study_sections
from tuning.reporting.content import Section
from tuning.reporting.reading import Results

TEMPLATE, SCRIPT, STYLE = "page.html.jinja", "magnify.js", "page.css"
HEADLINES = {
    content.GOOD: "Good: every requirement is met.",
    content.BAD: "Bad: not every requirement is met.",
    content.UNKNOWN: "Not decided: what was given does not show that every requirement is met.",
}


def page(results: Results, say: Callable[[str], None] = lambda _: None) -> bytes:
    """Return the HTML page of the results; `say` is called with the name of each plot."""
    requirements = content.requirements(results)
    verdict = content.verdict_of(requirements)
    sections: list[Section | None] = [
        content.assumptions(results),
        rig_sections.identification(results),
        rig_sections.monitoring(results),
        content.gains(results),
        study_sections.runs(results, say),
        study_sections.errors(results),
        study_sections.drivers(results),
        study_sections.comparison(results),
        content.watchdog(results),
        study_sections.stability_map(results, say),
        study_sections.reproduction(results),
    ]
    script = _text(SCRIPT)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = environment.from_string(_text(TEMPLATE)).render(
        title=content.title_of(results),
        verdict=verdict,
        headline=HEADLINES[verdict],
        requirements=requirements,
        sections=[section for section in sections if section is not None],
        style=Markup(_text(STYLE)),
        script=Markup(script),
        script_sha256=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        drawn=Markup,
    )
    return text.encode("utf-8")


def _text(name: str) -> str:
    """Return the text of a file of this package."""
    return (resources.files("tuning.reporting") / name).read_text(encoding="utf-8")
