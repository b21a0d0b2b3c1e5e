"""Registration of user-defined compensators and contact laws.

A compensator or contact law (here: a law) is an object of a class that may be defined in any module. After
registration, the name of the law can be used in mechanism files, gain files and function arguments like the
name of a built-in law. A registration applies to the current process only.
"""

import inspect
import math
import re
from collections.abc import Mapping
from typing import Any

from jaxhil.contact.laws import CONTACT_KEYS, CONTACT_LAWS, ContactLaw
from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Compensator, Gain
from jaxhil.mechanism.file import DEFAULT_MECHANISM, load
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig.registry import COMPENSATORS as RUNTIME_COMPENSATORS

_NAME_PATTERN = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,59}")
_RUNTIME_METHODS = ("step", "reset", "position_command", "next_contact")


def register(law: Compensator | ContactLaw, runtime: type | None = None) -> None:
    """Register a compensator or a contact law under its `name` in this process.

    The same class may be defined and registered again, for example by a notebook cell that runs twice. The
    new object then replaces the old one.

    Args:
        law: Compensator or contact law. Simulation, tuning and gain files can then use its name.
        runtime: Class of the compensator for the rig, in plain Python, with gains of the same names and units
            (see `jaxhil.rig.registry.Compensator`). The class is needed to export a controller.

    Raises:
        InputError: `law` is not an instance of `Compensator` or `ContactLaw`; its name belongs to a
            different law or is not a word of letters, digits and underscores; it contains arrays; a gain
            has no unit, or its nominal value for the default mechanism is out of its bounds; or `runtime`
            lacks a method or has different gains.

    Example:
        >>> import jaxhil
        >>> from jaxhil.laws.phase_lead.simulation import PhaseLead
        >>> class MyLead(PhaseLead):
        ...     name = "my_lead"
        >>> jaxhil.register(MyLead())
        >>> jaxhil.simulate("rig-300kg", "my_lead").compensator
        'my_lead'
    """
    if not isinstance(law, (Compensator, ContactLaw)):
        found = f"the class {law.__name__}" if isinstance(law, type) else format_value(law)
        allowed = "an instance of jaxhil.Compensator or jaxhil.ContactLaw"
        raise InputError(f"register: found {to_one_line(found, 60)}, expected {allowed}")
    table: dict[str, Any] = COMPENSATORS if isinstance(law, Compensator) else CONTACT_LAWS
    _check_name(law, table)
    _check_static(law)
    if isinstance(law, Compensator):
        _check_gains(law)
        if runtime is not None:
            _check_runtime(law, runtime)
            RUNTIME_COMPENSATORS[law.name] = runtime
        else:
            RUNTIME_COMPENSATORS.pop(law.name, None)
    elif runtime is not None:
        raise _make_error(
            law, "runtime", format_value(runtime), "none: contact laws run in the simulation only"
        )
    elif unknown := [key.name for key in law.keys or () if key not in CONTACT_KEYS.values()]:
        raise _make_error(law, "keys", unknown[0], f"keys of mechanism files: {', '.join(CONTACT_KEYS)}")
    table[law.name] = law


def _check_name(law: Compensator | ContactLaw, table: dict[str, Any]) -> None:
    """Raise `InputError` if the name of a law is invalid or belongs to a different law in `table`."""
    name = getattr(law, "name", None)
    if not isinstance(name, str) or not _NAME_PATTERN.fullmatch(name):
        where = f"register: {type(law).__name__}.name"
        allowed = "a word of letters, digits and underscores, defined by `name: ClassVar[str] = ...`"
        raise InputError(f"{where}: found {format_value(name or None)}, expected {allowed}")
    if name in table:
        home, other_home = ((type(x).__module__, type(x).__qualname__) for x in (law, table[name]))
        if home != other_home or home[0].startswith("jaxhil."):
            raise _make_error(law, "name", "the name of a registered law", f"none of {', '.join(table)}")


def _check_static(law: Compensator | ContactLaw) -> None:
    """Raise `InputError` unless a law is hashable and equal to itself: JAX uses it as a static argument."""
    try:
        hash(law)
        is_equal = bool(law == law)
    except Exception:
        is_equal = False
    if not is_equal:
        allowed = "only numbers, texts and tuples (no arrays)"
        raise _make_error(law, "fields", "a value that is not hashable", allowed)


def _check_gains(law: Compensator) -> None:
    """Raise `InputError` if name, unit or bounds of a compensator's gain are invalid."""
    gains = getattr(law, "gains", None)
    if not isinstance(gains, tuple) or not all(isinstance(gain, Gain) for gain in gains):
        raise _make_error(law, "gains", format_value(gains), "a tuple of jaxhil.Gain")
    names = [gain.name for gain in gains]
    for gain in gains:
        if (
            not isinstance(gain.name, str)
            or not _NAME_PATTERN.fullmatch(gain.name)
            or names.count(gain.name) > 1
        ):
            raise _make_error(
                law,
                "gains",
                format_value(gain.name),
                "a unique word of letters, digits and underscores",
            )
        if not isinstance(gain.unit, str) or not gain.unit:
            raise _make_error(
                law, f"gains.{gain.name}.unit", format_value(gain.unit), "a unit, '1' if there is none"
            )
        _check_bounds(law, gain, load(DEFAULT_MECHANISM).mechanism)


def _check_bounds(law: Compensator, gain: Gain, mechanism: Mechanism) -> None:
    """Raise `InputError` unless lower <= nominal <= upper holds for a gain with finite bounds."""
    values = {}
    for part in ("lower", "nominal", "upper"):
        try:
            values[part] = float(getattr(gain, part)(mechanism))
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
            allowed = f"a function of the mechanism that returns a number (tried on {mechanism.name})"
            raise _make_error(law, f"gains.{gain.name}.{part}", to_one_line(found, 100), allowed) from None
    lower, nominal, upper = values.values()
    if not (math.isfinite(lower) and math.isfinite(upper) and lower <= nominal <= upper):
        allowed = f"lower <= nominal <= upper, all finite (tried on {mechanism.name})"
        raise _make_error(
            law, f"gains.{gain.name}", f"lower {lower:g}, nominal {nominal:g}, upper {upper:g}", allowed
        )


def _check_runtime(law: Compensator, runtime: object) -> None:
    """Raise `InputError` if the class for the rig lacks a method, or has other gains than the compensator."""
    if not inspect.isclass(runtime):
        raise _make_error(
            law, "runtime", format_value(runtime), "a class like jaxhil.rig.registry.Compensator"
        )
    missing = [name for name in _RUNTIME_METHODS if not callable(getattr(runtime, name, None))]
    if missing:
        raise _make_error(
            law, "runtime", f"{runtime.__name__} without method {missing[0]}", "a class with this method"
        )
    gains = getattr(runtime, "gains", None)
    units = (
        {name: getattr(gain, "unit", None) for name, gain in gains.items()}
        if isinstance(gains, Mapping)
        else {}
    )
    law_units = {gain.name: gain.unit for gain in law.gains}
    if units != law_units:
        raise _make_error(
            law,
            "runtime.gains",
            _format_units(units),
            f"{_format_units(law_units)}, the gains of the compensator",
        )


def _format_units(gains: dict[str, Any]) -> str:
    return to_one_line(", ".join(f"{name} [{unit}]" for name, unit in gains.items()), 200) or "no gains"


def _make_error(law: Compensator | ContactLaw, part: str, found: str, allowed: str) -> InputError:
    """Return the error with the message "register NAME: PART: found ..., expected ..."."""
    return InputError(f"register {law.name}: {part}: found {found}, expected {allowed}")
