"""Options that commands and public functions share: their types, allowed values, defaults and help texts.

Each command has a frozen dataclass that defines its options. tyro turns the fields into options of the
command line, the decorator `add_options` turns them into keyword arguments of the Python function, and
`check_options` checks their values.
"""

import dataclasses
import functools
import inspect
import math
import re
import textwrap
import typing
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from jaxhil.errors import format_value
from tuning.api.arguments import ArgumentError, is_number

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class AllowedValues:
    """Allowed values of an option; if the option's type includes None, None is always allowed."""

    least: float = -math.inf  # smallest number, in the unit of the option
    most: float = math.inf  # largest number, in the unit of the option
    names: tuple[str, ...] = ()  # allowed names; empty for a number
    # allowed values in words, for error messages; if empty, the text follows from `least` and `most`
    words: str = ""


def number_option(meaning: str, **more: Any):
    """Return tyro's configuration of an option whose value is a number."""
    return arg(metavar="NUMBER", help=meaning, **more)


def folder_option(meaning: str):
    """Return tyro's configuration of an option whose value is an output folder."""
    return arg(aliases=("-o",), metavar="DIR", help=meaning)


def text_option(metavar: str | None, meaning: str, **more: Any):
    """Return tyro's configuration of an option whose help text states the default value."""
    return arg(metavar=metavar, help=meaning, help_behavior_hint="", **more)


OptionalFile = Annotated[
    Positional[str | None],
    text_option("[FILE]", "Mechanism file, or the name of a built-in one; by default 'varying'."),
]
Files = Annotated[
    Positional[tuple[str, ...]],
    text_option("[FILE ...]", "Mechanism files, or names of built-in ones; by default 'varying'."),
]
Overrides = Annotated[
    UseAppendAction[tuple[str, ...]],
    text_option(
        "PATH=VALUE",
        "Set a key of the mechanism file by its dotted path, such as approach.velocity=0.01; repeatable.",
        name="set",
    ),
]
Unset = Annotated[
    UseAppendAction[tuple[str, ...]],
    text_option(
        "PATH",
        "Remove a key, and its entry in [uncertainty], from the mechanism, after all --set; repeatable.",
        name="unset",
    ),
]
LimitRange = AllowedValues(0.0, words="a number >= 0")
Limit = Annotated[
    float, arg(metavar="NUMBER", help="Restitution error beyond which the verdict is bad."), LimitRange
]
OptionalLimit = Annotated[
    float | None,
    text_option(
        "NUMBER",
        "Error beyond which the verdict is bad: the restitution error, by default 0.01; in six axes the "
        "twist error, by default 0.05.",
    ),
    LimitRange,
]
SeedRange = AllowedValues(0)
Json = Annotated[
    FlagCreatePairsOff[bool], text_option(None, "Print only one JSON document on standard output.")
]
Timings = Annotated[
    FlagCreatePairsOff[bool], text_option(None, "Print the time of each kind of work on standard error.")
]
Scheduler = Annotated[
    str | None,
    arg(
        metavar="ADDRESS", help="Scheduler of a dask.distributed cluster whose workers run the computations."
    ),
]
Resume = Annotated[
    bool,
    arg(name="resume", metavar="", help="Continue after an interruption; finished work is not repeated."),
]
CompensatorName = Annotated[
    str | None, arg(metavar="NAME", help="Compensator, with the literature's gains; by default 'none'.")
]
GainSource = Annotated[
    str | None,
    arg(metavar="GAINS", help="Gain file: compensator, gains and, if FILE is not given, mechanism."),
]


Setting = Annotated[
    str | None, text_option("NAME", "Name of a predefined set of the compensator's gains for any mechanism.")
]


def check_options(options: Any) -> None:
    """Check the type and the allowed values of every option whose definition states them.

    Raises:
        InputError: If a value is not allowed; the message is "name: found X, expected Y".
    """
    for name, (kind, allowed) in _checked_options(type(options)).items():
        value = getattr(options, name)
        if value is not None or type(None) not in typing.get_args(kind):
            _check_option(name, value, kind, allowed)


@functools.cache
def _checked_options(options: type) -> dict[str, tuple[Any, AllowedValues]]:
    """Return type and allowed values of each option that is a flag or states its allowed values."""
    checked = {}
    for name, hint in typing.get_type_hints(options, include_extras=True).items():
        kind, *marks = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
        allowed = [mark for mark in marks if isinstance(mark, AllowedValues)]
        if allowed or kind is bool:
            checked[name] = kind, allowed[0] if allowed else AllowedValues()
    return checked


def _check_option(name: str, value: Any, kind: Any, allowed: AllowedValues) -> None:
    """Raise `ArgumentError` if the value of one option is not allowed."""
    if kind is bool:
        if not isinstance(value, bool):
            raise ArgumentError(name, format_value(value), "true or false")
        return
    if allowed.names:
        if value not in allowed.names:
            raise ArgumentError(name, format_value(value), ", ".join(allowed.names))
        return
    is_integer_option = int in (kind, *typing.get_args(kind))
    words = allowed.words or (
        f"an integer >= {allowed.least:g}" if is_integer_option else f"a number >= {allowed.least:g}"
    )
    has_right_type = is_number(value) and (isinstance(value, int) or not is_integer_option)
    if not has_right_type or not value >= allowed.least:
        raise ArgumentError(name, str(value) if has_right_type else format_value(value), words)
    if value > allowed.most:
        raise ArgumentError(name, str(value), allowed.words or f"at most {allowed.most:.15g}")


def add_options(options: type) -> Callable[[Function], Function]:
    """Return a decorator that adds the fields of the dataclass `options` to a function's signature.

    The function must accept the fields as `**options`. In its docstring, the help texts of the fields replace
    the line `OPTIONS` or `**options: see ...`.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        *first, _ = signature.parameters.values()
        taken = {parameter.name for parameter in first}
        fields = [field for field in dataclasses.fields(options) if field.name not in taken]
        keyword, kinds = inspect.Parameter.KEYWORD_ONLY, typing.get_type_hints(options)
        more = [
            inspect.Parameter(field.name, keyword, default=field.default, annotation=kinds[field.name])
            for field in fields
        ]
        function.__signature__ = signature.replace(parameters=[*first, *more])  # pyright: ignore
        lines = [_option_help(options, field.name) for field in fields]
        function.__doc__ = re.sub(
            r" +(\*\*options: see `\w+`\.|OPTIONS)\n", lambda _: "".join(lines), function.__doc__ or ""
        )
        return function

    return decorate


def _option_help(options: type, name: str) -> str:
    """Return the lines of a docstring's `Args` section that describe one option."""
    hint = typing.get_type_hints(options, include_extras=True)[name]
    (meaning,) = (mark.help for mark in typing.get_args(hint)[1:] if getattr(mark, "help", None))
    return textwrap.fill(f"{name}: {meaning}", 110, initial_indent=" " * 8, subsequent_indent=" " * 12) + "\n"
