"""Parts of the controller in C99 that come from tables of the runtime: gains, limits, faults, statuses.

Each table becomes a struct or constants with the Python descriptions, and a check that accepts the same
values as the runtime. The struct of gains begins with control period and clearance, which the laws also need.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from jaxhil.rig.bounds import CONTROL_PERIODS, DISTANCES, format_range
from jaxhil.rig.faults import FAULTS, UNUSABLE
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.law_status import STATUSES
from jaxhil.rig.limits import LIMITS
from jaxhil.rig.registry import COMPENSATORS

MAX_LINE_WIDTH = 110


# Conditions of `limits.complete` besides the range of each limit.
_LIMIT_RELATIONS = (
    "limits->measured_lowest < limits->measured_highest",
    "limits->command_lowest < limits->command_highest",
    "!(limits->retreat_velocity > limits->velocity_limit)",
)


class CFragment(NamedTuple):
    """Fragment of C code made from a table."""

    comment: str  # comment above it
    declarations: str  # code for the header
    definitions: str  # code for the source


def format_double(value: float) -> str:
    """Return a double as C text with 17 significant digits, which is read back as the same double."""
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "-INFINITY"
    text = f"{value:.17g}"
    return text if "." in text or "e" in text else f"{text}.0"


def gains_fragment(law: str) -> CFragment:
    """Return the struct `jaxhil_gains` of a compensator, and the check of its values."""
    clearance = f"(({_range_condition('clearance', *DISTANCES)}) || gains->clearance == INFINITY)"
    entries = [
        ("control_period", f"s, {format_range(*CONTROL_PERIODS)}"),
        ("clearance", f"m, {format_range(*DISTANCES)}, of a contact with two sides; infinite with one"),
    ]
    checks = [_range_condition("control_period", *CONTROL_PERIODS), clearance]
    for name, gain in COMPENSATORS[law].gains.items():
        entries.append((name, f"{gain.unit}, {format_range(gain.lowest, gain.highest)}"))
        checks.append(_range_condition(name, gain.lowest, gain.highest))
    return CFragment(
        f"/* The gains of the compensator `{law}`, within bounds that no gain file can move. */\n",
        _define_struct("jaxhil_gains", entries),
        _check_function("jaxhil_gains_admitted", "jaxhil_gains", "gains", checks),
    )


def limits_fragment() -> CFragment:
    """Return the struct `jaxhil_limits`, the check of its values, and the default limits."""
    entries = [
        (name, f"{limit.unit}, {format_range(limit.lowest, limit.highest)}: {limit.meaning}")
        for name, limit in LIMITS.items()
    ]
    checks = [_range_condition(name, limit.lowest, limit.highest, "limits") for name, limit in LIMITS.items()]
    defaults = _initialisers(
        {name: limit.default for name, limit in LIMITS.items()},
        {name: limit.unit for name, limit in LIMITS.items()},
    )
    return CFragment(
        "/* The limits of the controller, each within bounds that no gain file can move. */\n",
        _define_struct("jaxhil_limits", entries),
        f"static const jaxhil_limits jaxhil_no_limits = {{\n{defaults}}};\n\n"
        + _check_function("jaxhil_limits_fit", "jaxhil_limits", "limits", [*checks, *_LIMIT_RELATIONS]),
    )


def faults_fragment() -> CFragment:
    """Return the bits of the faults, and the function for their names."""
    named = [(f"JAXHIL_{fault.name.upper()}", fault) for fault in FAULTS]
    lines = []
    for name, fault in named:
        lines.append(_format_comment(f"{fault.condition}; reaction: {fault.reaction}", "    "))
        lines.append(f"    {name} = 0x{fault.bit:X},\n")
    lines.append(
        "    /* the gains or limits given to jaxhil_init are not admitted; reaction: stays tripped */\n"
    )
    lines.append(f"    JAXHIL_UNUSABLE = 0x{UNUSABLE:X}\n")
    cases = "".join(f'    case {name}:\n        return "{fault.name}";\n' for name, fault in named)
    return CFragment(
        "/* What can go wrong on the rig, and what the controller does about it: one bit each, raised on\n"
        " * the tick at which it happens. A trip is latched. */\n",
        f"enum {{\n{''.join(lines)}}};\n\n"
        '/* The name of a fault, from its one bit; "" if it has none. */\n'
        "const char *jaxhil_fault_name(uint32_t bit);\n",
        "const char *jaxhil_fault_name(uint32_t bit) {\n    switch (bit) {\n"
        f"{cases}"
        '    case JAXHIL_UNUSABLE:\n        return "unusable";\n'
        '    default:\n        return "";\n    }\n}\n',
    )


def statuses_fragment() -> CFragment:
    """Return the statuses of a compensator, and the function for their names."""
    named = [(f"JAXHIL_{status.name.upper()}", status) for status in STATUSES]
    lines = [
        f"{_format_comment(status.meaning, '    ')}    {name} = {status.number}" for name, status in named
    ]
    joined = ",\n".join(lines)
    cases = "".join(f'    case {name}:\n        return "{status.name}";\n' for name, status in named)
    return CFragment(
        "/* What a law may say of its last command. */\n",
        f"enum {{\n{joined}\n}};\n\n"
        '/* The name of a status; "" if there is none of the number. */\n'
        "const char *jaxhil_law_status_name(int status);\n",
        "const char *jaxhil_law_status_name(int status) {\n    switch (status) {\n"
        f'{cases}    default:\n        return "";\n    }}\n}}\n',
    )


def gain_file_constants(gain_file: GainFile) -> str:
    """Return the gains and the limits of a gain file as constants of those structs."""
    units = {"control_period": "s", "clearance": "m"}
    units |= {name: gain.unit for name, gain in COMPENSATORS[gain_file.compensator].gains.items()}
    gains = {
        "control_period": gain_file.control_period,
        "clearance": gain_file.clearance,
        **{name: gain_file.gains[name] for name in COMPENSATORS[gain_file.compensator].gains},
    }
    limit_units = {name: limit.unit for name, limit in LIMITS.items()}
    limits = {name: gain_file.limits[name] for name in LIMITS}
    return (
        f"static const jaxhil_gains jaxhil_exported_gains = {{\n{_initialisers(gains, units)}}};\n\n"
        f"static const jaxhil_limits jaxhil_exported_limits = {{\n{_initialisers(limits, limit_units)}}};\n"
    )


def _initialisers(values: Mapping[str, float], units: Mapping[str, str]) -> str:
    """Return initialisers in the order of the struct; C++ has no names for fields before C++20."""
    return "".join(
        f"    {format_double(value)}, /* {name}, {units[name]} */\n" for name, value in values.items()
    )


def _define_struct(name: str, entries: Iterable[tuple[str, str]]) -> str:
    """Return the definition of a struct of doubles."""
    lines = "".join(f"{_format_comment(meaning, '    ')}    double {entry};\n" for entry, meaning in entries)
    return f"typedef struct {{\n{lines}}} {name};\n"


def _range_condition(name: str, lowest: float, highest: float, struct: str = "gains") -> str:
    """Return a C condition that a value is in its range; without bounds, that it is finite."""
    open_below, open_above = math.isinf(lowest), math.isinf(highest)
    conditions = [f"isfinite({struct}->{name})"] * (open_below or open_above)
    conditions += [] if open_below else [f"{struct}->{name} >= {format_double(lowest)}"]
    conditions += [] if open_above else [f"{struct}->{name} <= {format_double(highest)}"]
    return " && ".join(conditions)


def _check_function(function: str, struct: str, argument: str, checks: Iterable[str]) -> str:
    """Return a C function that checks all conditions."""
    joined = " &&\n           ".join(checks)
    return f"static bool {function}(const {struct} *{argument}) {{\n    return {joined};\n}}\n"


def _format_comment(text: str, indent: str) -> str:
    """Return text as an indented C comment."""
    lines = textwrap.wrap(text, MAX_LINE_WIDTH - len(indent) - 6, break_long_words=False)
    return f"{indent}/* {f'{chr(10)}{indent} * '.join(lines)} */\n"
