"""Arguments of the front door's functions: each checked, and refused in one line if it will not do.

The same line serves function and command: an `ArgumentError` knows how its argument is called as an option.
"""

import functools
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import open_input
from jaxhil.laws import names
from jaxhil.mechanism.file import AnyMechanism, LoadedAny, LoadedMechanism, source_sha256
from jaxhil.mechanism.loading import as_any_mechanism, as_mechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism

if TYPE_CHECKING:
    from jaxhil.simulation.gain_file import LoadedGains

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


SIX_AXES = names(6)


class ArgumentError(InputError):
    """An unusable argument: "name: found X, allowed Y"; `option` says it of the command's option. Where an
    argument holds several things, `which` of them is meant comes after the name."""

    def __init__(self, name: str, found: str, allowed: str, which: str = ""):
        text = f"{f': {which}' if which else ''}: found {found}, allowed {allowed}"
        super().__init__(name + text)
        self.option = f"--{name.replace('_', '-')}{text}"


def entry(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function of the front door: what the system refuses is an `InputError` too."""

    @functools.wraps(function)
    def called(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        try:
            return function(*arguments, **named)
        except OSError as error:
            where = f"{one_line(os.fspath(error.filename))}: " if isinstance(error.filename, str) else ""
            raise InputError(f"{where}{one_line(error.strerror or str(error), 200)}") from None

    return called


def integers(least: int, most: int | None = None, **given: Any) -> None:
    """Every argument given is an integer, `least` <= it <= `most`."""
    for name, value in given.items():
        if isinstance(value, bool) or not isinstance(value, int):
            raise ArgumentError(name, shown(value), f"an integer >= {least}")
        if value < least:
            raise ArgumentError(name, str(value), f"an integer >= {least}")
        if most is not None and value > most:
            raise ArgumentError(name, str(value), f"at most {most}")


def one_of(allowed: Sequence[str], **given: Any) -> None:
    """Every argument given is one of the `allowed` names."""
    for name, value in given.items():
        if value not in allowed:
            raise ArgumentError(name, shown(value), ", ".join(allowed))


def limit(value: Any) -> None:
    """A limit of the restitution error is a number >= 0; infinite where there is none."""
    if not is_number(value) or math.isnan(value) or value < 0:
        raise ArgumentError("limit", str(value) if is_number(value) else shown(value), "a number >= 0")


def flags(**given: Any) -> None:
    """Every argument given is true or false."""
    for name, value in given.items():
        if not isinstance(value, bool):
            raise ArgumentError(name, shown(value), "true or false")


def is_number(value: Any) -> bool:
    """Whether it is a real number, of Python or of NumPy."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def compensators(names: Iterable[Any], argument: str = "compensator") -> None:
    """Every name is a compensator's, built in or registered."""
    known = compensator_names()
    for name in names:
        one_of(known, **{argument: name})


def fits(compensator: Any, mechanism: AnyMechanism | None, argument: str = "compensator") -> None:
    """The name is that of a compensator of the mechanism's axes; of some axes where there is none yet."""
    if mechanism is None:
        one_of(tuple(dict.fromkeys([*compensator_names(), *SIX_AXES])), **{argument: compensator})
    elif not isinstance(mechanism, SixAxisMechanism):
        compensators([compensator], argument)
    elif compensator not in SIX_AXES:
        allowed = f"{', '.join(SIX_AXES)}: in six axes there are no others so far"
        raise ArgumentError(argument, shown(compensator), allowed)


def not_in_six_axes(mechanism: AnyMechanism, **given: Any) -> None:
    """Nothing is given, or asked for, that six axes do not have yet."""
    for name, value in given.items():
        if isinstance(mechanism, SixAxisMechanism) and value:
            found = "a function" if callable(value) else shown(value)
            raise ArgumentError(name, found, "nothing: in six axes there is none so far")


def compensator_names() -> tuple[str, ...]:
    """Of all compensators, the registered ones last. Starts no jax where there are none."""
    loaded = sys.modules.get("jaxhil.laws.compensators")
    return tuple(dict.fromkeys([*names(), *(loaded.COMPENSATORS if loaded else ())]))


def setting(compensator: str, value: Any) -> None:
    """The compensator has a setting of that name, if one is given. Imports jax then."""
    if value is None:
        return
    from jaxhil.laws.compensators import compensator_of

    names = compensator_of(compensator).settings
    if value not in names:
        allowed = ", ".join(names) or f"none, {compensator} has no settings"
        raise ArgumentError("setting", shown(value), allowed)


def several(given: Any, kinds: tuple[type, ...]) -> tuple[list[Any], bool]:
    """What is given as a list, one of the `kinds` alone being a list of one; whether it was a list."""
    if isinstance(given, kinds) or not isinstance(given, Iterable) or isinstance(given, Mapping):
        return [given], False
    return list(given), True


def folder(name: str, value: Any) -> Path:
    """A path, whatever is there."""
    if not isinstance(value, (str, os.PathLike)):
        raise ArgumentError(name, shown(value), "a path")
    return Path(value)


def mechanisms(given: Any) -> tuple[list[LoadedMechanism], bool]:
    """The mechanisms of one axis given, one or several, each as `jaxhil.load` returns it or by its name or
    file; whether there were several. Raises `InputError`."""
    listed, many = _listed(given)
    checked = [as_mechanism(one) for one in listed]
    return [LoadedMechanism(one, source_sha256(one), one.name) for one in checked], many


def any_mechanisms(given: Any) -> tuple[list[LoadedAny], bool]:
    """Likewise, of one axis or of six."""
    listed, many = _listed(given)
    checked = [as_any_mechanism(one) for one in listed]
    return [LoadedAny(one, source_sha256(one), one.name) for one in checked], many


def _listed(given: Any) -> tuple[list[Any], bool]:
    listed, many = several(given, (Mechanism, SixAxisMechanism, str, os.PathLike))
    if not listed:
        raise ArgumentError("mechanism", "an empty list", "one mechanism or more")
    return listed, many


def gain_file(given: Any, argument: str = "gains", any_axes: bool = False) -> "LoadedGains":
    """The gains given: a gain file's path, or its folder's, or what has a gain file's `document`; of one
    axis, unless `any_axes` will do."""
    from jaxhil.simulation.gain_file import check_document, load_gain_file

    document = getattr(given, "document", None)
    if isinstance(document, Mapping):
        return check_document(dict(document), any_axes=any_axes)
    path = folder(argument, given)
    return load_gain_file(path / "gains.json" if path.is_dir() else path, any_axes)


def readable_gain_file(given: Any, argument: str = "gains") -> Path:
    """The gain file at `given`, or in the folder there. Raises `InputError` if it cannot be read at all."""
    try:
        path = folder(argument, given)
        if path.is_dir():
            path = path / "gains.json"
        with open_input(path) as file:
            file.read(1)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        where = one_line(os.fspath(given)) or repr(given)
        raise InputError(f"{where}: cannot be read: {one_line(reason)}") from None
    return path


def runtime(compensator: str) -> None:
    """The law can run on the rig. Raises `InputError` for one that was registered without a runtime."""
    from jaxhil.rig import COMPENSATORS

    if compensator not in COMPENSATORS:
        raise InputError(
            f"{compensator}: found no runtime class for the rig, "
            f"allowed a law registered with one: jaxhil.register(law, runtime=...)"
        )
