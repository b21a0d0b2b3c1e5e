"""`jaxhil report`: one page of what the other commands wrote."""

from pathlib import Path

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import remove_stale, writing
from jaxhil.simulation.environment import prepare
from tuning import terminal
from tuning.cli.options_report import Report
from tuning.front_door.report import report

ENDINGS = (".html", ".htm")


def run(options: Report) -> int:
    """Write the page; 1 if its verdict is bad, else 0."""
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
    made = report(options.results, progress=True)
    made.save(target)
    if options.json:
        terminal.emit_json(
            {"report": str(target), "verdict": made.verdict, "requirements": made.requirements}
        )
    else:
        rows = [tuple(one.values()) for one in made.requirements]
        heads = ["judged", "required", "result", "margin", "verdict"]
        tables = [terminal.table("Requirements", heads, rows, texts=range(5))] if rows else []
        terminal.emit(*tables, f"Verdict: {made.verdict}.")
        terminal.emit_line(f"Wrote {one_line(str(target))}, {len(made.html) / 1e6:.2g} MB")
    return 1 if made.verdict == "bad" else 0
