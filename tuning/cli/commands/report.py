"""Command `jaxhil report`: writes one HTML page with the results of the other commands."""

from pathlib import Path

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import remove_stale, report_write_errors
from jaxhil.simulation.jax_environment import prepare_jax
from tuning import terminal
from tuning.api.report import report
from tuning.cli.options_report import ReportOptions

PAGE_SUFFIXES = (".html", ".htm")


def run(options: ReportOptions) -> int:
    """Write the HTML report, and print its requirements; return exit code 1 if its verdict is bad, else 0."""
    if not options.results:
        raise InputError("RESULT: found none, expected results of jaxhil identify, tune, sweep, ...")
    target = Path(options.output)
    if target.suffix.lower() not in PAGE_SUFFIXES:
        allowed = f"a name that ends in {', '.join(PAGE_SUFFIXES)}"
        raise InputError(f"--output: found {format_value(options.output)}, expected {allowed}")
    with report_write_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(target.parent)
    prepare_jax()
    page = report(options.results, progress=True)
    page.save(target)
    if options.json:
        content = {"report": str(target), "verdict": page.verdict, "requirements": page.requirements}
        terminal.emit_json("report", content)
    else:
        rows = [tuple(requirement.values()) for requirement in page.requirements]
        headings = ["quantity", "required", "result", "margin", "verdict"]
        tables = [terminal.build_table("Requirements", headings, rows, texts=range(5))] if rows else []
        terminal.emit(*tables, f"Verdict: {page.verdict}.")
        terminal.emit_line(f"Wrote {to_one_line(str(target))}, {len(page.html) / 1e6:.2g} MB")
        terminal.emit_line("Next: open this page in a browser")
    return 1 if page.verdict == "bad" else 0
