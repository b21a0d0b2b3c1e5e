"""Checks of the arguments of public functions; a failed check raises an error with a message of one line.

The commands use the same checks: an `ArgumentError` contains a second text, which names the command's option
instead of the function's argument.
"""

import functools
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import open_input
from jaxhil.laws import built_in_compensators
from jaxhil.mechanism.file import AnyMechanism, LoadedAnyMechanism, source_sha256
from jaxhil.mechanism.loading import as_any_mechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism

if TYPE_CHECKING:
    from jaxhil.simulation.gain_file import LoadedGains

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


SIX_AXIS_COMPENSATOR_NAMES = built_in_compensators(6)
# Default limit of the restitution error, and in six axes of the twist error [1]. In six axes, the usual 1 %
# of cross-talk in a force sensor causes twist errors of 0.03 to 0.1, which no compensator reduces.
DEFAULT_LIMIT, SIX_AXIS_DEFAULT_LIMIT = 0.01, 0.05


# Options of the command line whose names differ from those of the arguments in Python.
OPTION_NAMES = {"judged": "evaluated", "validation": "evaluated"}


class ArgumentError(InputError):
    """Error for an unusable argument, with the message "name: found X, expected Y".

    Attributes:
        option: the same message for the command line, which begins with the option "--name".
    """

    def __init__(self, name: str, found: str, allowed: str, entry: str = ""):
        """Create the error.

        Args:
            name: name of the argument.
            found: unusable value, as text.
            allowed: description of the allowed values.
            entry: name of the wrong entry if the argument has several entries.
        """
        text = f"{f': {entry}' if entry else ''}: found {found}, expected {allowed}"
        super().__init__(name + text)
        self.option = f"--{OPTION_NAMES.get(name, name).replace('_', '-')}{text}"


def convert_os_errors(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a public function so that an `OSError` raised in it is converted to an `InputError`."""

    @functools.wraps(function)
    def wrapper(*arguments: Parameters.args, **keywords: Parameters.kwargs) -> Result:
        try:
            return function(*arguments, **keywords)
        except OSError as error:
            where = f"{to_one_line(os.fspath(error.filename))}: " if isinstance(error.filename, str) else ""
            raise InputError(f"{where}{to_one_line(error.strerror or str(error), 200)}") from None

    return wrapper


def check_integers(least: int, most: int | None = None, **values: Any) -> None:
    """Raise `ArgumentError` unless every value is an integer from `least` to `most` (None: no maximum).

    The keywords are the names of the arguments.
    """
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int):
            raise ArgumentError(name, format_value(value), f"an integer >= {least}")
        if value < least:
            raise ArgumentError(name, str(value), f"an integer >= {least}")
        if most is not None and value > most:
            raise ArgumentError(name, str(value), f"at most {most}")


def check_choice(allowed: Sequence[str], **values: Any) -> None:
    """Raise `ArgumentError` unless every value is one of the `allowed` names.

    The keywords are the names of the arguments.
    """
    for name, value in values.items():
        if value not in allowed:
            raise ArgumentError(name, format_value(value), ", ".join(allowed))


def check_limit(value: Any) -> None:
    """Raise `ArgumentError` unless the argument `limit` is None or a number >= 0, possibly infinite."""
    if value is None:
        return
    if not is_number(value) or math.isnan(value) or value < 0:
        raise ArgumentError("limit", str(value) if is_number(value) else format_value(value), "a number >= 0")


def choose_limit(value: float | None, mechanism: AnyMechanism) -> float:
    """Return the limit of the error [1]: `value` or, if it is None, the default for one or for six axes."""
    if value is not None:
        return value
    return SIX_AXIS_DEFAULT_LIMIT if isinstance(mechanism, SixAxisMechanism) else DEFAULT_LIMIT


def check_booleans(**values: Any) -> None:
    """Raise `ArgumentError` unless every value is true or false; the keywords are the arguments' names."""
    for name, value in values.items():
        if not isinstance(value, bool):
            raise ArgumentError(name, format_value(value), "true or false")


def is_number(value: Any) -> bool:
    """Return whether a value is an `int` or `float` (this includes NumPy's `float64`), but not a `bool`."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def check_compensators(names: Iterable[Any], argument: str = "compensator") -> None:
    """Raise `ArgumentError` unless every name is that of a built-in or registered compensator."""
    allowed = compensator_names()
    for name in names:
        check_choice(allowed, **{argument: name})


def check_supports_mechanism(
    compensator: Any, mechanism: AnyMechanism | None, argument: str = "compensator"
) -> None:
    """Raise `ArgumentError` unless the compensator exists for the number of axes of the mechanism.

    If the mechanism is None, compensators for one axis and for six axes are accepted.
    """
    if mechanism is None:
        check_choice(
            tuple(dict.fromkeys([*compensator_names(), *SIX_AXIS_COMPENSATOR_NAMES])),
            **{argument: compensator},
        )
    elif not isinstance(mechanism, SixAxisMechanism):
        check_compensators([compensator], argument)
    elif compensator not in SIX_AXIS_COMPENSATOR_NAMES:
        allowed = f"one of {', '.join(SIX_AXIS_COMPENSATOR_NAMES)} for six axes"
        raise ArgumentError(argument, format_value(compensator), allowed)


def check_one_axis_arguments(mechanism: AnyMechanism, **values: Any) -> None:
    """Raise `ArgumentError` if the mechanism has six axes and an option that needs one axis is set.

    The keywords are the names of the arguments.
    """
    for name, value in values.items():
        if isinstance(mechanism, SixAxisMechanism) and value:
            found = "a function" if callable(value) else format_value(value)
            raise ArgumentError(name, found, "none: this option is not available for six axes")


def compensator_names() -> tuple[str, ...]:
    """Return the names of all built-in compensators, then those of the registered compensators.

    This function does not import jax. As long as jax is not imported, no compensator can be registered.
    """
    module = sys.modules.get("jaxhil.laws.compensators")
    return tuple(dict.fromkeys([*built_in_compensators(), *(module.COMPENSATORS if module else ())]))


def check_setting_name(compensator: str, value: Any, axes: int = 1) -> None:
    """Raise `ArgumentError` unless `value` is None or the name of a setting (named gains) of the compensator.

    Unless `value` is None, this function imports jax.
    """
    if value is None:
        return
    from jaxhil.laws.compensators import get_compensator

    names = get_compensator(compensator, axes).settings
    if value not in names:
        allowed = ", ".join(names) or f"none: {compensator} has no settings"
        raise ArgumentError("setting", format_value(value), allowed)


def as_list(value: Any, kinds: tuple[type, ...]) -> tuple[list[Any], bool]:
    """Return one value or several values as a list, and whether `value` contained several.

    A value of one of the types `kinds`, a mapping, or a value that is not iterable is a single value.
    """
    if isinstance(value, kinds) or not isinstance(value, Iterable) or isinstance(value, Mapping):
        return [value], False
    return list(value), True


def check_path(name: str, value: Any) -> Path:
    """Convert an argument to a path, which need not exist; raise `ArgumentError` if it is not a path."""
    if not isinstance(value, (str, os.PathLike)):
        raise ArgumentError(name, format_value(value), "a path")
    return Path(value)


def load_any_mechanisms(value: Any) -> tuple[list[LoadedAnyMechanism], bool]:
    """Return a list of loaded mechanisms with one or six axes, and whether `value` was a list of mechanisms.

    A mechanism is a result of `jaxhil.load`, or a name or path that `jaxhil.load` accepts. Raise `InputError`
    if a mechanism is unusable.
    """
    listed, is_list = _as_mechanism_list(value)
    checked = [as_any_mechanism(entry) for entry in listed]
    return [
        LoadedAnyMechanism(mechanism, source_sha256(mechanism), mechanism.name) for mechanism in checked
    ], is_list


def _as_mechanism_list(value: Any) -> tuple[list[Any], bool]:
    """Return mechanisms as a list, and whether `value` was a list; an empty list raises `ArgumentError`."""
    listed, is_list = as_list(value, (Mechanism, SixAxisMechanism, str, os.PathLike))
    if not listed:
        raise ArgumentError("mechanism", "an empty list", "one mechanism or more")
    return listed, is_list


def load_gains(value: Any, argument: str = "gains", any_axes: bool = False) -> "LoadedGains":
    """Load and check a gain file.

    Args:
        value: path of a gain file or of its folder, or an object whose attribute `document` is the content of
            a gain file, such as a result of `tuning.tune`.
        argument: name of the argument in error messages.
        any_axes: whether gains for six axes are accepted too.

    Returns:
        The gains with their compensator and mechanism.

    Raises:
        InputError: If the gains cannot be read or are not valid.
    """
    from jaxhil.simulation.gain_file import check_document, load_gain_file

    document = getattr(value, "document", None)
    if isinstance(document, Mapping):
        return check_document(dict(document), any_axes=any_axes)
    path = check_path(argument, value)
    return load_gain_file(path / "gains.json" if path.is_dir() else path, any_axes)


def find_gain_file(value: Any, argument: str = "gains") -> Path:
    """Return the path of a gain file; `value` is this path or the path of the file's folder.

    Raise `InputError` if the file cannot be read.
    """
    try:
        path = check_path(argument, value)
        if path.is_dir():
            path = path / "gains.json"
        with open_input(path) as file:
            file.read(1)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        where = to_one_line(os.fspath(value)) or repr(value)
        raise InputError(f"{where}: cannot be read: {to_one_line(reason)}") from None
    return path


def check_has_runtime(compensator: str, axes: int = 1) -> None:
    """Raise `InputError` if the compensator was registered without a runtime class for the rig."""
    from tuning.bundle.controller_kind import kind_of

    if compensator not in kind_of({"axes": axes}).compensators:
        raise InputError(
            f"{compensator}: found no runtime class for the rig, expected a compensator that was registered "
            "with a runtime class: jaxhil.register(compensator, runtime=...)"
        )
