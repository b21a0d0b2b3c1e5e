"""Checks of options that commands share; each raises `InputError`, one line. Nothing here imports jax."""

import math
from pathlib import Path

from jaxhil.errors import InputError, shown
from tuning.cli import PICTURES


def at_least(least: int, **options: int) -> None:
    """Every option is at least `least`."""
    for name, value in options.items():
        if value < least:
            raise InputError(f"--{name}: found {value}, allowed an integer >= {least}")


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


def compensator(name: str) -> None:
    """The name is a compensator's."""
    # The runtime's table: the same names, without jax.
    from jaxhil.runtime.registry import COMPENSATORS

    if name not in COMPENSATORS:
        raise InputError(f"--compensator: found {shown(name)}, allowed {', '.join(COMPENSATORS)}")
