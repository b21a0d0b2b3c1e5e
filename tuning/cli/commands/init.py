"""Command `jaxhil init`: writes a new mechanism file to start from."""

import json
import shlex
from pathlib import Path

import msgspec

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import write_new, writing
from jaxhil.mechanism.file import DEFAULT, builtin_names, builtin_path, load, six_axis_names, suite_names
from jaxhil.mechanism.template import commented
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import Init

SUFFIX = ".toml"


def run(options: Init) -> int:
    """Write the mechanism file, or list the names; return 0."""
    names = [*builtin_names(), *suite_names(), *six_axis_names()]
    if options.list:
        if options.json:
            terminal.emit_json({"names": names})
        else:
            terminal.emit(*names)
        return 0
    source, output = options.name or DEFAULT, options.output
    if source.endswith(SUFFIX):  # the argument is the file, not a built-in name
        if output is not None:
            raise InputError(f"--output: found {shown(output)} beside a file, allowed one of them")
        source, output = DEFAULT, source
    builtin_path(source)  # raises InputError for a name that is not built in
    path = Path(output or f"mechanism{SUFFIX}")
    name = one_line(path.name.removesuffix(SUFFIX), 100) or source
    text = _of_six_axes(source, name) if source in six_axis_names() else _of_one_axis(source, name)
    label = one_line(str(path))
    checks.output(path.parent)
    with writing(path):
        try:
            write_new(path, text.encode())
        except FileExistsError:
            taken = "found something there, allowed a name that is not taken: nothing is overwritten"
            raise InputError(f"--output: {label}: {taken}") from None
    if options.json:
        terminal.emit_json({"file": str(path), "name": name, "from": source})
    else:
        law = " --compensator phase_lead" if source in six_axis_names() else ""
        then = f"jaxhil tune {shlex.quote(label)}{law}"
        terminal.emit(f"{label}: written, with the values of {source}. Change it, then: {then}")
    return 0


def _of_one_axis(source: str, name: str) -> str:
    """Return the text of a built-in one-axis mechanism, with a comment for every key."""
    return commented(msgspec.structs.replace(load(source).mechanism, name=name))


def _of_six_axes(source: str, name: str) -> str:
    """Return the text of a built-in six-axis file, whose comments explain its keys, under a new name."""
    # A mechanism's name is printable, so its JSON string is also valid TOML.
    named = f"name = {json.dumps(name, ensure_ascii=False)}"
    return builtin_path(source).read_text(encoding="utf-8").replace(f'name = "{source}"', named, 1)
