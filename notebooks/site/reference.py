"""The reference pages of the site, as Markdown made of the types, options, laws and messages of the package.

Each function returns one page. What lacks a meaning or a unit raises ValueError, so that no page is built
without it.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import typing
from collections.abc import Iterable, Sequence
from typing import Any

from messages import messages
from tyro.conf import FlagCreatePairsOff, Positional

import jaxhil
import tuning
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS as SIX_AXIS_LAWS
from jaxhil.laws.simulation_base import Gain
from jaxhil.mechanism.file import builtin_names, load, load_any, six_axis_names, suite_names
from jaxhil.mechanism.json_schema import build_json_schema
from jaxhil.mechanism.keys import KeyDescription, TableDescription, describe_tables
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from tuning.cli.parser import DESCRIPTION, Command

DEFAULT = "varying"


def pages() -> dict[str, str]:
    """Every generated page, by its path on the site; the JSON Schema too."""
    return {
        "reference/mechanism_file.md": mechanism_file(),
        "reference/mechanism_file_six_axes.md": mechanism_file_six_axes(),
        "reference/mechanism.schema.json": json.dumps(build_json_schema(), indent=2) + "\n",
        "reference/commands.md": commands(),
        "reference/gains.md": gains(),
        "reference/messages.md": messages(),
        "reference/python.md": python(),
    }


def mechanism_file() -> str:
    """Every key of the mechanism file, and the built-in files."""
    return "\n".join([MECHANISM_FILE, *map(_table_of_keys, describe_tables()), BUILT_IN, *_built_in()]) + "\n"


def mechanism_file_six_axes() -> str:
    """The same of six axes."""
    described = map(_table_of_keys, describe_tables(SixAxisMechanism))
    rows = [[f"`{name}`", load_any(name).mechanism.source] for name in six_axis_names()]
    built_in = _table(["name", "where its numbers come from"], rows)
    return "\n".join([SIX_AXES, *described, BUILT_IN, built_in]) + "\n"


def commands() -> str:
    """Every command with every option."""
    sections = [_command(*typing.get_args(entry)) for entry in typing.get_args(Command)]
    return "\n\n".join([f"# Commands\n\n```text\n{DESCRIPTION}\n```", *sections]) + "\n"


def gains() -> str:
    """The gain file, and the gains of every compensator for a mechanism with one axis and one with six."""
    one_axis, six_axes = load(DEFAULT).mechanism, load_any(six_axis_names()[0]).mechanism
    laws = [(name, law, one_axis) for name, law in COMPENSATORS.items()]
    laws += [(f"{name}, six axes", law, six_axes) for name, law in SIX_AXIS_LAWS.items()]
    sections = [GAINS]
    for name, law, mechanism in laws:
        rows = [_row_of_gain(gain, mechanism) for gain in law.gains]
        text = inspect.getdoc(inspect.getmodule(type(law))) or ""
        known = ", ".join(law.knows) or "nothing"
        sections += [f"### {name}\n\nHas to know beforehand: {known}.\n\n```text\n{text.strip()}\n```"]
        if rows:
            heads = ["gain", "unit", "lower", "upper", "literature", "tuned"]
            sections.append(_table(heads, rows))
    return "\n\n".join(sections) + "\n"


def python() -> str:
    """The functions and classes of the two front doors."""
    homes = {f"jaxhil.{name}": f"{home}.{name}" for name, home in jaxhil._MODULES.items()}
    homes |= {f"tuning.{name}": f"tuning.api.{name}.{name}" for name in tuning.__all__}
    options = {"show_root_heading": "false", "show_root_toc_entry": "false", "heading_level": "3"}
    stated = "".join(f"\n      {option}: {value}" for option, value in options.items())
    entries = [f"## {name}\n\n::: {home}\n    options:{stated}" for name, home in homes.items()]
    return "\n\n".join([PYTHON, *entries]) + "\n"


def _table_of_keys(table: TableDescription) -> str:
    title = f"`[{table.path}]`" if table.path else "Head of the file"
    heads = ["key", "meaning", "unit", "allowed", "default", "used by"]
    return f"\n## {title}\n\n{table.meaning}\n\n{_table(heads, map(_row_of_key, table.keys))}\n"


def _row_of_gain(gain: Gain, mechanism: Mechanism) -> list[str]:
    if not gain.unit:
        raise ValueError(f"{gain.name}: a gain without unit")
    numbers = [f"{value(mechanism):.4g}" for value in (gain.lower, gain.upper, gain.nominal)]
    return [f"`{gain.name}`", gain.unit, *numbers, "yes" if gain.tuned(mechanism) else "no"]


def _row_of_key(key: KeyDescription) -> list[str]:
    unit = {None: "", "": "that of the key"}.get(key.unit, key.unit)
    default = "required" if key.required else "none" if key.default is None else f"`{_toml(key.default)}`"
    return [f"`{key.name}`", key.meaning, unit or "", key.allowed, default, ", ".join(key.users) or "all"]


def _toml(value: Any) -> str:
    return json.dumps(value).replace("Infinity", "inf")


def _built_in() -> list[str]:
    rows = []
    for name in [*builtin_names(), *suite_names()]:
        mechanism = load(name).mechanism
        rows.append([f"`{name}`", mechanism.contact.law, str(mechanism.approach.contacts), mechanism.source])
    return [_table(["name", "contact law", "contacts", "where its numbers come from"], rows)]


def _command(options: type, *about: Any) -> str:
    name = about[0].name
    hints = typing.get_type_hints(options, include_extras=True)
    rows = []
    for field in dataclasses.fields(options):
        kind, *marks = typing.get_args(hints[field.name])
        said = next(mark for mark in marks if hasattr(mark, "metavar"))
        if not said.help:
            raise ValueError(f"{name}: {field.name} has no help")
        negated = kind is bool and FlagCreatePairsOff not in marks
        usage = _usage(field.name, said, Positional in marks, negated)
        rows.append([usage, said.help, _default(field, said)])
    document = inspect.getdoc(options) or ""
    example = "\n\n".join(
        f"```sh\n{part.removeprefix('Example: ')}\n```"
        if part.startswith("Example: ")
        else " ".join(part.split())
        for part in document.split("\n\n")
    )
    return f"## jaxhil {name}\n\n{example}\n\n{_table(['option', 'meaning', 'default'], rows)}"


def _usage(field: str, said: Any, positional: bool, negated: bool) -> str:
    if positional:
        return f"`{said.metavar}`"
    name = (said.name or field).replace("_", "-")
    names = [*(said.aliases or ()), f"--{name}"]
    names += [f"--no-{one.removeprefix('--')}" for one in names if negated]
    return f"`{', '.join(sorted(names, key=len))}{f' {said.metavar}' if said.metavar else ''}`"


def _default(field: dataclasses.Field, said: Any) -> str:
    if field.default is dataclasses.MISSING:
        return "required"
    # What the help says itself, or a flag, or nothing.
    empty = field.default is None or field.default == () or field.default is False
    return "" if empty or said.help_behavior_hint == "" else f"`{field.default}`"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = [[cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
    lines = [heads, ["---"] * len(heads), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


MECHANISM_FILE = """\
# The mechanism file

TOML, one file for one docking mechanism on one rig: `schema = "jaxhil/mechanism/1"`. `jaxhil init
my-rig.toml` writes one with every key explained. This page is made of the types that read it. Numbers are in
SI units, natural frequencies in Hz. A key that is not given has its default; an unknown key, a wrong type or
a value that is not allowed ends in one line that names file, key, what was found and what is allowed, and in
exit code 2. A key that the chosen law or model does not use is refused where it says anything.

Editors complete and check such files by the [JSON Schema](mechanism.schema.json)
(`jaxhil mechanisms --schema > mechanism.schema.json`); those that go by a line of the file itself want
`#:schema ./mechanism.schema.json` as its first one.

Any key can be replaced for one call: `--set contact.damping=[100.0]`, or taken out: `--unset uncertainty`.
"""
SIX_AXES = """\
# The mechanism file of six axes

`schema = "jaxhil/mechanism/2"`: two rigid bodies, the shapes on them that touch, a rig of six axes. What a
key means in the physics, and the frames, are on the page on [six axes](../guide/six_axes.md). `"KEY"` stands
for a name of your own. Six numbers may be said as one, or as a table of the two that are named among what is
allowed.
"""
BUILT_IN = """\
## Built-in files

`jaxhil mechanisms` says where they are; `jaxhil init NAME -o FILE` starts from one.
"""
GAINS = f"""\
# Gain file and gains

## The gain file

JSON, `schema = "jaxhil/gains/1"`, written by `jaxhil tune` and read by `sweep`, `verify`, `export` and the
rig's controller:

| key | holds |
| --- | --- |
| `schema` | `jaxhil/gains/1` |
| `compensator` | the law's name |
| `gains` | of each gain `value`, `unit`, and the bounds `lower` and `upper` |
| `control_period` | [s], which the rig's has to equal |
| `mechanism` | the whole mechanism, with what `--set` and `--unset` changed |
| `mechanism_sha256` | SHA-256 of its file |
| `envelope` | `low`, `high` and `unit` of the contact frequency, delay, speed and force it was tuned over |
| `figures` | what the gains reach, beside the literature's and none |
| `seed`, `versions`, `created`, `timings` | how it was made |
| `sha256` | digest of the content, dates and timings apart |

A file whose digest, schema, units, bounds or control period do not fit is refused.

## Gains of each law

Bounds and the literature's value follow from the mechanism; these are those of `{DEFAULT}`. "no" in the last
column: for this mechanism tuning leaves the gain at the literature's value."""
PYTHON = """\
# Python

`import jaxhil` and `import tuning`: what the [guide](../guide/python.md) uses, function by function."""
