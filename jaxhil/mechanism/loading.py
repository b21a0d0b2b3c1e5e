"""Loading of a mechanism from a built-in name, a file's path, or a `Mechanism` object."""

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
    """Load a mechanism from a TOML file, or a built-in one.

    Args:
        name_or_path: name of a built-in mechanism, or path of a file.
        overrides: values in SI units that replace those of the file, by key. A key is a dotted path such as
            ``rig.force_sensor.delay``, possibly with an index (``contact.stiffness[1]``). The value None
            removes the key, as ``--unset`` does, and its entry of ``[uncertainty]``.

    Returns:
        A `Mechanism`, or a `SixAxisMechanism` if the file's schema has six axes.

    Raises:
        InputError: if the file, a key or a value is wrong. The message is one line.

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
    """Validate a one-axis mechanism, or load that of a name or path. Raise `InputError`."""
    if not isinstance(argument, (Mechanism, SixAxisMechanism)):
        return file.load(_source(argument)).mechanism
    # Structs do not validate their fields: a mechanism that was not read from a file is unchecked.
    return file.from_plain_data(file.to_plain_data(argument), f"mechanism {format_value(argument.name)}")


def as_any_mechanism(argument: object) -> file.AnyMechanism:
    """Validate a mechanism with one axis or with six, or load that of a name or path. Raise `InputError`."""
    if not isinstance(argument, (Mechanism, SixAxisMechanism)):
        return file.load_any(_source(argument)).mechanism
    return file.any_from_plain_data(file.to_plain_data(argument), f"mechanism {format_value(argument.name)}")


def _source(argument: object) -> str | os.PathLike[str]:
    """Return a name or path. Raise `InputError` for any other argument."""
    if isinstance(argument, (str, os.PathLike)) and isinstance(os.fspath(argument), str):
        return argument
    allowed = "a Mechanism, the name of a built-in one or a path"
    raise InputError(f"mechanism: found {format_value(argument)}, expected {allowed}")
