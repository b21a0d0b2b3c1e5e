"""Command `jaxhil report`: writes one page from the results of the other commands."""

from pathlib import Path

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import remove_stale, writing
from jaxhil.simulation.environment import prepare
from tuning import terminal
from tuning.cli.options_report import Report
from tuning.front_door.report import report

ENDINGS = (".html", ".htm")


def run(options: Report) -> int:
    """Write the page; return 1 if its verdict is bad, else 0."""
    if not options.results:
        raise InputError("RESULT: found nothing, allowed what jaxhil identify, tune, sweep, ... wrote")
    target = Path(options.output)
    if target.suffix.lower() not in ENDINGS:
        allowed = f"a name that ends in {', '.join(ENDINGS)}"
        raise InputError(f"--output: found {shown(options.output)}, allowed {allowed}")
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(target.parent)
    prepare()
    page = report(options.results, progress=True)
    page.save(target)
    if options.json:
        terminal.emit_json(
            {"report": str(target), "verdict": page.verdict, "requirements": page.requirements}
        )
    else:
        rows = [tuple(requirement.values()) for requirement in page.requirements]
        heads = ["judged", "required", "result", "margin", "verdict"]
        tables = [terminal.table("Requirements", heads, rows, texts=range(5))] if rows else []
        terminal.emit(*tables, f"Verdict: {page.verdict}.")
        terminal.emit_line(f"Wrote {one_line(str(target))}, {len(page.html) / 1e6:.2g} MB")
    return 1 if page.verdict == "bad" else 0
