"""Selection of the mechanism, compensator and gains from --compensator, --gains, --setting and FILE."""

from pathlib import Path

from jaxhil.errors import InputError, one_line, shown
from jaxhil.mechanism.file import (
    AnyMechanism,
    any_from_builtins,
    from_builtins,
    load,
    load_any,
    to_builtins,
)
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from tuning.cli.options import Simulate
from tuning.cli.options_report import Map
from tuning.front_door import arguments


def named(options: Simulate | Map) -> Mechanism | None:
    """Return the mechanism of FILE, or None if the mechanism of the gain file is used.

    Raise `InputError`, also for an unknown compensator or a six-axis mechanism. This does not import jax.
    """
    return load(options.file, options.overrides, options.unset).mechanism if _by_file(options) else None


def named_any(options: Simulate) -> AnyMechanism | None:
    """Return the mechanism of FILE like `named`, with one axis or with six."""
    if options.compensator is not None:
        arguments.fits(options.compensator, None)
    if options.gains is not None and options.file is None:
        return None
    mechanism = load_any(options.file, options.overrides, options.unset).mechanism
    arguments.fits(options.compensator or "none", mechanism)
    return mechanism


def in_six_axes(options: Simulate) -> SixAxisMechanism | None:
    """Return the mechanism of a six-axis gain file, or None if the gain file has one axis.

    Raise `InputError`. This imports jax.
    """
    from jaxhil.simulation.gain_file import load_gain_file

    assert options.gains is not None
    _check_setting(options)
    mechanism = load_gain_file(options.gains, any_axes=True).mechanism
    if not isinstance(mechanism, SixAxisMechanism):
        return None
    label = one_line(options.gains)
    changed = any_from_builtins(to_builtins(mechanism), label, options.overrides, options.unset)
    assert isinstance(changed, SixAxisMechanism)
    return changed


def _by_file(options: Simulate | Map) -> bool:
    """Check the compensator's name, and return whether the mechanism comes from FILE."""
    if options.compensator is not None:
        arguments.compensators([options.compensator])
    return options.gains is None or options.file is not None


def chosen(options: Simulate | Map, mechanism: Mechanism | None) -> tuple[Mechanism, str, str | Path | None]:
    """Return the mechanism, the compensator, and its setting or gain file, if any.

    `mechanism` is the result of `named`. Raise `InputError`. This imports jax.
    """
    if options.gains is None:
        assert mechanism is not None
        compensator = options.compensator or "none"
        arguments.setting(compensator, options.setting)
        return mechanism, compensator, options.setting

    from jaxhil.simulation.gain_file import load_gain_file

    _check_setting(options)
    loaded = load_gain_file(options.gains)
    label = one_line(options.gains)
    if options.compensator not in (None, loaded.compensator):
        raise InputError(
            f"--compensator: found {options.compensator}, allowed {loaded.compensator}, which {label} is for"
        )
    if mechanism is None:
        raw = to_builtins(loaded.mechanism)
        mechanism = from_builtins(raw, label, options.overrides, options.unset)
    return mechanism, loaded.compensator, Path(options.gains)


def _check_setting(options: Simulate | Map) -> None:
    """Raise `InputError` if a setting is given together with a gain file."""
    if options.setting is not None:
        raise InputError(f"--setting: found {shown(options.setting)}, allowed none beside a gain file")
