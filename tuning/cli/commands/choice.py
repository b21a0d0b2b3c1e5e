"""Selection of the mechanism, compensator and gains from --compensator, --gains, --setting and FILE."""

from pathlib import Path

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.file import AnyMechanism, any_from_plain_data, load_any, to_plain_data
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from tuning import terminal
from tuning.api import arguments
from tuning.cli.options import SimulateOptions
from tuning.cli.options_report import Map


def suggest_next(options: SimulateOptions | Map, compensator: str) -> None:
    """Suggest a command after a simulation or map: a sweep of the gains or, without gains, a tuning."""
    if options.gains is not None:
        terminal.suggest("sweep", options.gains)
        return
    words = [] if options.file is None else [options.file]
    words += [] if compensator == "none" else ["--compensator", compensator]
    for option, changes in (("--set", options.overrides), ("--unset", options.unset)):
        words += [word for change in changes for word in (option, change)]
    terminal.suggest("tune", *words)


def load_any_named_mechanism(options: SimulateOptions | Map) -> AnyMechanism | None:
    """Load the mechanism of FILE, with one or six axes; return None if the gain file's mechanism is used.

    Raise `InputError` if FILE is unusable or the compensator does not support its axes. This function does
    not import jax.
    """
    if options.compensator is not None:
        arguments.check_supports_mechanism(options.compensator, None)
    if options.gains is not None and options.file is None:
        return None
    mechanism = load_any(options.file, options.overrides, options.unset).mechanism
    arguments.check_supports_mechanism(options.compensator or "none", mechanism)
    return mechanism


def load_six_axis_mechanism(options: SimulateOptions) -> SixAxisMechanism | None:
    """Return the mechanism in a six-axis gain file, or None if the gain file is for one axis.

    Raise `InputError` if the gain file or an override is unusable. This function imports jax.
    """
    from jaxhil.simulation.gain_file import load_gain_file

    assert options.gains is not None
    _check_setting(options)
    mechanism = load_gain_file(options.gains, any_axes=True).mechanism
    if not isinstance(mechanism, SixAxisMechanism):
        return None
    label = to_one_line(options.gains)
    changed = any_from_plain_data(to_plain_data(mechanism), label, options.overrides, options.unset)
    assert isinstance(changed, SixAxisMechanism)
    return changed


def select_compensator(
    options: SimulateOptions, mechanism: Mechanism | None
) -> tuple[Mechanism, str, str | Path | None]:
    """Return the one-axis mechanism, the compensator's name, and the source of the gains.

    See `select_any_compensator`. Raise `InputError` if the gain file is for six axes.
    """
    selected, compensator, gains = _select(options, mechanism, any_axes=False)
    assert isinstance(selected, Mechanism)
    return selected, compensator, gains


def select_any_compensator(
    options: SimulateOptions | Map, mechanism: AnyMechanism | None
) -> tuple[AnyMechanism, str, str | Path | None]:
    """Return the mechanism, the compensator's name, and the source of the gains.

    The source is the name of a setting, the path of a gain file, or None for the literature's gains.
    `mechanism` is the result of `load_any_named_mechanism`. Raise `InputError` if an option is unusable, or
    if mechanism and gain file have different numbers of axes. This function imports jax.
    """
    return _select(options, mechanism, any_axes=not isinstance(mechanism, Mechanism))


def _select(
    options: SimulateOptions | Map, mechanism: AnyMechanism | None, any_axes: bool
) -> tuple[AnyMechanism, str, str | Path | None]:
    """Return the values of `select_any_compensator`; reject six-axis gain files unless `any_axes`."""
    if options.gains is None:
        assert mechanism is not None
        compensator = options.compensator or "none"
        axes = 6 if isinstance(mechanism, SixAxisMechanism) else 1
        arguments.check_setting_name(compensator, options.setting, axes)
        return mechanism, compensator, options.setting

    from jaxhil.simulation.gain_file import load_gain_file

    _check_setting(options)
    loaded = load_gain_file(options.gains, any_axes)
    label = to_one_line(options.gains)
    if options.compensator not in (None, loaded.compensator):
        raise InputError(
            f"--compensator: found {options.compensator}, expected {loaded.compensator}, as in {label}"
        )
    if mechanism is None:
        raw = to_plain_data(loaded.mechanism)
        mechanism = any_from_plain_data(raw, label, options.overrides, options.unset)
    return mechanism, loaded.compensator, Path(options.gains)


def _check_setting(options: SimulateOptions | Map) -> None:
    """Raise `InputError` if `--setting` is used together with a gain file."""
    if options.setting is not None:
        raise InputError(
            f"--setting: found {format_value(options.setting)}, expected none together with --gains"
        )
