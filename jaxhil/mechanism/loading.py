"""A mechanism from whatever names it: a built-in's name, a file's path, or the `Mechanism` itself."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from jaxhil.errors import InputError, shown
from jaxhil.mechanism import file
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism

__all__ = ["as_any_mechanism", "as_mechanism", "load"]


def load(
    name_or_path: str | os.PathLike[str] = file.DEFAULT, overrides: Mapping[str, Any] | None = None
) -> Any:
    """The mechanism of a built-in's name, or of a TOML file: a `Mechanism`, or a `SixAxisMechanism`, as its
    schema says.

    `overrides` maps keys to values, in SI units, which replace those of the file: a key is a dotted path,
    such as ``rig.force_sensor.delay``, possibly with an index (``contact.stiffness[1]``). The value None
    takes the key out, as ``--unset`` does, and with it what ``[uncertainty]`` says of it.

    Raises `InputError`, one line, for whatever is wrong: file, key, what was found and what is allowed.
    """
    if not (overrides is None or isinstance(overrides, Mapping)):
        raise InputError(f"overrides: found {shown(overrides)}, allowed a dict from dotted paths to values")
    return file.load_any(_source(name_or_path), overrides or {}).mechanism


def as_mechanism(given: object) -> Mechanism:
    """The mechanism given, checked; or that of the name or path given; of one axis. Raises `InputError`."""
    if not isinstance(given, (Mechanism, SixAxisMechanism)):
        return file.load(_source(given)).mechanism
    # Structs hold what they are given: one that was not read from a file was not checked yet.
    return file.from_builtins(file.to_builtins(given), f"mechanism {shown(given.name)}")


def as_any_mechanism(given: object) -> file.AnyMechanism:
    """Likewise, of one axis or of six."""
    if not isinstance(given, (Mechanism, SixAxisMechanism)):
        return file.load_any(_source(given)).mechanism
    return file.any_from_builtins(file.to_builtins(given), f"mechanism {shown(given.name)}")


def _source(given: object) -> str | os.PathLike[str]:
    if isinstance(given, (str, os.PathLike)) and isinstance(os.fspath(given), str):
        return given
    allowed = "a Mechanism, the name of a built-in one or a path"
    raise InputError(f"mechanism: found {shown(given)}, allowed {allowed}")
