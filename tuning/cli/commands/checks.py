"""Checks of options that commands share; each raises `InputError`, one line. Nothing here imports jax."""

import math
from collections.abc import Sequence
from pathlib import Path

from jaxhil.errors import InputError, one_line, shown
from tuning.cli.options import PICTURES


def at_least(least: int, **options: int) -> None:
    """Every option is at least `least`."""
    for name, value in options.items():
        if value < least:
            raise InputError(f"--{name}: found {value}, allowed an integer >= {least}")


def one_of(allowed: Sequence[str], **options: str) -> None:
    """Every option is one of the `allowed` names."""
    for name, value in options.items():
        if value not in allowed:
            raise InputError(f"--{name}: found {shown(value)}, allowed {', '.join(allowed)}")


def setting(compensator: str, value: str | None) -> None:
    """The compensator has a setting of that name. Starts jax."""
    if value is None:
        return
    from jaxhil.compensators import COMPENSATORS

    names = COMPENSATORS[compensator].settings
    if value not in names:
        allowed = ", ".join(names) or f"none, {compensator} has no settings"
        raise InputError(f"--setting: found {shown(value)}, allowed {allowed}")


def limit(value: float) -> None:
    """A limit is a number >= 0."""
    if math.isnan(value) or value < 0:
        raise InputError(f"--limit: found {value}, allowed a number >= 0")


def picture(path: str) -> None:
    """A picture can be written there; folders on the way are made. Raises OSError too."""
    target = Path(path)
    if target.suffix.lower() not in PICTURES:
        raise InputError(f"--plot: found {shown(path)}, allowed a name that ends in {', '.join(PICTURES)}")
    target.parent.mkdir(parents=True, exist_ok=True)


def gain_file(given: str) -> Path:
    """The gain file at `given`, or in the folder there. Raises `InputError` if it cannot be read at all."""
    try:
        path = Path(given)
        if path.is_dir():
            path = path / "gains.json"
        with path.open("rb") as file:
            file.read(1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{one_line(given) or repr(given)}: cannot be read: {one_line(reason)}") from None
    return path


def folder(given: str) -> Path | None:
    """The folder at `given`; None if there is none, or it cannot be read."""
    try:
        return Path(given) if Path(given).is_dir() else None
    except (OSError, ValueError):
        return None


def compensator(name: str) -> None:
    """The name is a compensator's."""
    # The runtime's table: the same names, without jax.
    from jaxhil.runtime.registry import COMPENSATORS

    if name not in COMPENSATORS:
        raise InputError(f"--compensator: found {shown(name)}, allowed {', '.join(COMPENSATORS)}")
