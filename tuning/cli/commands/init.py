"""`jaxhil init`: a mechanism file to start from, written where no file is."""

import shlex
from pathlib import Path

import msgspec

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import write_new, writing
from jaxhil.mechanism.file import DEFAULT, builtin_names, builtin_path, load, suite_names
from jaxhil.mechanism.template import commented
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import Init

SUFFIX = ".toml"


def run(options: Init) -> int:
    """Write it, or list the names; always 0."""
    names = [*builtin_names(), *suite_names()]
    if options.list:
        if options.json:
            terminal.emit_json({"names": names})
        else:
            terminal.emit(*names)
        return 0
    source, output = options.name or DEFAULT, options.output
    if source.endswith(SUFFIX):  # the file, not a name
        if output is not None:
            raise InputError(f"--output: found {shown(output)} beside a file, allowed one of them")
        source, output = DEFAULT, source
    builtin_path(source)  # refuses a name that is not built in
    path = Path(output or f"mechanism{SUFFIX}")
    name = one_line(path.name.removesuffix(SUFFIX), 100) or source
    mechanism = msgspec.structs.replace(load(source).mechanism, name=name)
    place = one_line(str(path))
    checks.output(path.parent)
    with writing(path):
        try:
            write_new(path, commented(mechanism).encode())
        except FileExistsError:
            taken = "found something there, allowed a name that is not taken: nothing is overwritten"
            raise InputError(f"--output: {place}: {taken}") from None
    if options.json:
        terminal.emit_json({"file": str(path), "name": name, "from": source})
    else:
        then = f"jaxhil tune {shlex.quote(place)}"
        terminal.emit(f"{place}: written, with the values of {source}. Change it, then: {then}")
    return 0
