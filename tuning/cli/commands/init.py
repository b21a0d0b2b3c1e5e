"""Command `jaxhil init`: writes a new mechanism file to start from."""

import json
import re
from pathlib import Path

import msgspec

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.file import (
    DEFAULT_MECHANISM,
    builtin_names,
    builtin_path,
    load,
    six_axis_names,
    suite_names,
)
from jaxhil.mechanism.template import format_mechanism_file
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import InitOptions

SUFFIX = ".toml"


def run(options: InitOptions) -> int:
    """Write a mechanism file, or list the names of the built-in mechanisms; return exit code 0."""
    names = [*builtin_names(), *suite_names(), *six_axis_names()]
    if options.list:
        if options.json:
            terminal.emit_json("init", {"names": names})
        else:
            terminal.emit(*names)
            terminal.note("Next: jaxhil init NAME")
        return 0
    source, output = options.name or DEFAULT_MECHANISM, options.output
    if source.endswith(SUFFIX):  # the argument is the file, not a built-in name
        if output is not None:
            raise InputError(f"--output: found {format_value(output)} and {source}, expected only one file")
        source, output = DEFAULT_MECHANISM, source
    builtin_path(source)  # raises InputError for a name that is not built in
    path = Path(output or f"mechanism{SUFFIX}")
    name = to_one_line(path.name.removesuffix(SUFFIX), 100) or source
    text = _six_axis_text(source, name) if source in six_axis_names() else _one_axis_text(source, name)
    label = to_one_line(str(path))
    checks.prepare_output_folder(path.parent)
    checks.write_mechanism_file("--output", path, text)
    if options.json:
        terminal.emit_json("init", {"file": str(path), "name": name, "from": source})
    else:
        terminal.emit_line(f"{label}: written, with the values of {source}: change them first")
        terminal.suggest("simulate", str(path))
    return 0


def _one_axis_text(source: str, name: str) -> str:
    """Return the file text of a built-in one-axis mechanism under a new name, with a comment for each key."""
    changes = {"name": name, "source": _describe_source(source)}
    return format_mechanism_file(msgspec.structs.replace(load(source).mechanism, **changes))


def _six_axis_text(source: str, name: str) -> str:
    # A mechanism's name is printable, so its JSON string is also valid TOML.
    named = f"name = {json.dumps(name, ensure_ascii=False)}"
    text = builtin_path(source).read_text(encoding="utf-8").replace(f'name = "{source}"', named, 1)
    return re.sub(r'^source = ".*"$', f'source = "{_describe_source(source)}"', text, count=1, flags=re.M)


def _describe_source(source: str) -> str:
    """Return the text of the key `source` for a new file that contains the values of a built-in file."""
    return f"the values of the built-in {source}, until you replace them and this text"
