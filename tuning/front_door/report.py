"""`tuning.report`: one page for a review board, of what the other functions and commands wrote."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from jaxhil.files import follow, write_whole, writing
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments
from tuning.front_door.arguments import ArgumentError


@dataclass(frozen=True)
class Report:
    """What `report` returns."""

    html: bytes  # the page
    verdict: str  # "good", "bad", or "unknown" where what was given does not decide it
    requirements: list[dict[str, str]]  # what, required, result, margin and verdict of each

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page, whole or not at all. Raises `InputError` if that is not possible."""
        target = arguments.folder("path", path)
        with writing(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            write_whole(follow(target), self.html)


@arguments.entry
def report(
    results: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], *, progress: bool = False
) -> Report:
    """One page of results: verdict, requirements, assumptions, gains, runs, errors, how to reproduce them.

    Args:
        results: paths of what `identify`, `tune`, `sweep`, `compare`, `map` and `export` wrote, at most one
            of each: a folder or the JSON file in it; of `monitor` the file of what `--json` printed.
        progress: say on standard error what is going on.

    Raises:
        InputError: one line, for what is no result, was changed since it was written, or belongs to another
            mechanism or other gains than the rest.
    """
    arguments.flags(progress=progress)
    listed, _ = arguments.several(results, (str, os.PathLike))
    if not listed:
        raise ArgumentError("results", "none", "paths of results")
    paths = [arguments.folder("results", one) for one in listed]
    with computing():
        from tuning.reporting.content import requirements, verdict_of
        from tuning.reporting.page import page
        from tuning.reporting.reading import read_results
        from tuning.reporting.study_sections import pictures

        found = read_results(paths)
        with terminal.progress(pictures(found), "pictures", progress) as bar:
            html = page(found, bar.turn_to)
        asked = requirements(found)
        return Report(html, verdict_of(asked), [_plain(one) for one in asked])


def _plain(one: Any) -> dict[str, str]:
    return {**vars(one)}


__all__ = ["Report", "report"]
