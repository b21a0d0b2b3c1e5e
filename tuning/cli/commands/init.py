"""`jaxhil init`: a mechanism file to start from, written where no file is."""

from pathlib import Path

import msgspec

from jaxhil.errors import InputError, one_line
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
    # `jaxhil init my-rig.toml` means the file, too.
    names_file = options.name is not None and options.name.endswith(SUFFIX)
    path = Path(options.name if options.name and names_file else options.output)
    source = DEFAULT if options.name is None or names_file else options.name
    builtin_path(source)  # refuses a name that is not built in
    name = one_line(path.name.removesuffix(SUFFIX), 100) or source
    mechanism = msgspec.structs.replace(load(source).mechanism, name=name)
    shown = one_line(str(path))
    checks.output(path.parent)
    with writing(path):
        try:
            write_new(path, commented(mechanism).encode())
        except FileExistsError:
            taken = "found something there, allowed a name that is not taken: nothing is overwritten"
            raise InputError(f"--output: {shown}: {taken}") from None
    if options.json:
        terminal.emit_json({"file": str(path), "name": name, "from": source})
    else:
        terminal.emit(f"{shown}: written, with the values of {source}. Change it, then: jaxhil tune {shown}")
    return 0
