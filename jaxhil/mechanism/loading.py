"""Loading of a mechanism from a built-in name, the path of a file, or a `Mechanism` object."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from jaxhil.errors import InputError, format_value
from jaxhil.mechanism import file
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism

__all__ = ["as_any_mechanism", "as_mechanism", "load"]


def load(
    name_or_path: str | os.PathLike[str] = file.DEFAULT_MECHANISM, overrides: Mapping[str, Any] | None = None
) -> Any:
    """Load and validate a mechanism from a TOML file, or a built-in mechanism by its name.

    Args:
        name_or_path: name of a built-in mechanism, or path of a file.
        overrides: new values in SI units for keys of the file. A key is a dotted path such as
            ``rig.force_sensor.delay``, possibly with an index (``contact.stiffness[1]``). The value None
            removes the key and its entry in ``[uncertainty]``, as ``--unset`` does.

    Returns:
        A `Mechanism`, or a `SixAxisMechanism` if the file's schema has six axes.

    Raises:
        InputError: if the file, a key or a value is invalid. The message is one line.

    Example:
        >>> import jaxhil
        >>> jaxhil.load("rig-300kg", {"rig.force_sensor.delay": 0.003}).rig.force_sensor.delay
        0.003
    """
    if not (overrides is None or isinstance(overrides, Mapping)):
        raise InputError(
            f"overrides: found {format_value(overrides)}, expected a dict from dotted paths to values"
        )
    return file.load_any(_source(name_or_path), overrides or {}).mechanism


def as_mechanism(argument: object) -> Mechanism:
    """Return a validated one-axis mechanism from a name, path or object.

    Raise `InputError` if the mechanism is invalid.
    """
    if not isinstance(argument, (Mechanism, SixAxisMechanism)):
        return file.load(_source(argument)).mechanism
    # Structs do not validate their fields: a mechanism that was not read from a file is unchecked.
    return file.from_plain_data(file.to_plain_data(argument), f"mechanism {format_value(argument.name)}")


def as_any_mechanism(argument: object) -> file.AnyMechanism:
    """Return a validated one-axis or six-axis mechanism from a name, path or object.

    Raise `InputError` if the mechanism is invalid.
    """
    if not isinstance(argument, (Mechanism, SixAxisMechanism)):
        return file.load_any(_source(argument)).mechanism
    return file.any_from_plain_data(file.to_plain_data(argument), f"mechanism {format_value(argument.name)}")


def _source(argument: object) -> str | os.PathLike[str]:
    """Return the argument if it is a name or a path. Raise `InputError` otherwise."""
    if isinstance(argument, (str, os.PathLike)) and isinstance(os.fspath(argument), str):
        return argument
    expected = "a Mechanism, the name of a built-in mechanism, or a path"
    raise InputError(f"mechanism: found {format_value(argument)}, expected {expected}")
