"""C code for the runtime's tables of gains, limits, faults and statuses.

Each table becomes a C struct or enumeration, with the descriptions of the Python code as comments. For gains
and limits, a C function accepts exactly the values that the Python runtime accepts. The struct of gains
starts with control period and clearance, which the compensators also need.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxhil.rig.bounds import CONTROL_PERIODS, DISTANCES, format_range
from jaxhil.rig.faults import UNUSABLE, Fault
from jaxhil.rig.law_status import STATUSES
from jaxhil.rig.limits import Limit
from jaxhil.rig.registry import GainSpecification
from jaxhil.rig.six_axes.gain_file import MATRIX_ENTRIES
from tuning.bundle.controller_kind import ControllerKind

MAX_LINE_WIDTH = 110
CLEARANCE_ENTRY = f"m, {format_range(*DISTANCES)}, between two surfaces; infinite for one surface"

NO_CONTRACTION = """\
/* Forbid fused operations, which compute a * b + c with one rounding. GCC does not support the C99 pragma. */
#if defined(_MSC_VER) && !defined(__clang__)
#pragma fp_contract(off)
#elif defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=off")
#else
#pragma STDC FP_CONTRACT OFF
#endif
"""


class CFragment(NamedTuple):
    """C code of one table, in one part for the header file and one for the source file."""

    comment: str  # comment above the declarations
    declarations: str  # code for the header file
    definitions: str  # code for the source file


def format_double(value: float) -> str:
    """Return a C literal with 17 significant digits, from which a compiler reads the same double."""
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "-INFINITY"
    text = f"{value:.17g}"
    return text if "." in text or "e" in text else f"{text}.0"


def gains_fragment(law: str, kind: ControllerKind) -> CFragment:
    """Return the C struct `jaxhil_gains` of the compensator `law`, and a function that checks its values."""
    entries = [("control_period", f"s, {format_range(*CONTROL_PERIODS)}")]
    checks = [_range_condition("control_period", *CONTROL_PERIODS)]
    if kind.axes == 1:
        entries.append(("clearance", CLEARANCE_ENTRY))
        checks.append(f"(({_range_condition('clearance', *DISTANCES)}) || gains->clearance == INFINITY)")
    gains: Mapping[str, GainSpecification] = kind.compensators[law].gains
    for name, gain in gains.items():
        entries.append((name, f"{gain.unit}, {format_range(gain.lowest, gain.highest)}"))
        checks.append(_range_condition(name, gain.lowest, gain.highest))
    return CFragment(
        f"/* Gains of the compensator `{law}`; a gain file cannot change their ranges. */\n",
        _define_struct("jaxhil_gains", entries),
        _check_function("jaxhil_gains_admitted", "jaxhil_gains", "gains", checks),
    )


def limits_fragment(kind: ControllerKind) -> CFragment:
    """Return the C struct `jaxhil_limits`, a function that checks its values, and the default limits."""
    limits: Mapping[str, Limit] = kind.limits
    relations = [f"limits->{low} < limits->{high}" for low, high in kind.ranges]
    relations += [f"!(limits->{low} > limits->{high})" for low, high in kind.order]
    entries = [
        (name, f"{limit.unit}, {format_range(limit.lowest, limit.highest)}: {limit.meaning}")
        for name, limit in limits.items()
    ]
    checks = [_range_condition(name, limit.lowest, limit.highest, "limits") for name, limit in limits.items()]
    defaults = _initialisers(
        {name: limit.default for name, limit in limits.items()},
        {name: limit.unit for name, limit in limits.items()},
    )
    return CFragment(
        "/* Limits of the controller; a gain file cannot change their ranges. */\n",
        _define_struct("jaxhil_limits", entries),
        f"static const jaxhil_limits jaxhil_no_limits = {{\n{defaults}}};\n\n"
        + _check_function("jaxhil_limits_fit", "jaxhil_limits", "limits", [*checks, *relations]),
    )


def faults_fragment(faults: Sequence[Fault]) -> CFragment:
    """Return a C enumeration of the faults' bits, and a function that returns the name of a fault."""
    named = [(f"JAXHIL_{fault.name.upper()}", fault) for fault in faults]
    lines = []
    for name, fault in named:
        lines.append(_format_comment(f"{fault.condition}; reaction: {fault.reaction}", "    "))
        lines.append(f"    {name} = 0x{fault.bit:X},\n")
    lines.append(
        "    /* a gain or limit given to jaxhil_init is out of its range; reaction: stays tripped */\n"
    )
    lines.append(f"    JAXHIL_UNUSABLE = 0x{UNUSABLE:X}\n")
    cases = "".join(f'    case {name}:\n        return "{fault.name}";\n' for name, fault in named)
    return CFragment(
        "/* Faults on the rig, and the controller's reactions. Each fault is one bit, which is set in the\n"
        " * tick in which the fault occurs. A trip is latched. */\n",
        f"enum {{\n{''.join(lines)}}};\n\n"
        '/* Return the name of the fault with this bit; "" if there is no such fault. */\n'
        "const char *jaxhil_fault_name(uint32_t bit);\n",
        "const char *jaxhil_fault_name(uint32_t bit) {\n    switch (bit) {\n"
        f"{cases}"
        '    case JAXHIL_UNUSABLE:\n        return "unusable";\n'
        '    default:\n        return "";\n    }\n}\n',
    )


def statuses_fragment() -> CFragment:
    """Return a C enumeration of the compensator's statuses, and a function that returns a status's name."""
    named = [(f"JAXHIL_{status.name.upper()}", status) for status in STATUSES]
    lines = [
        f"{_format_comment(status.meaning, '    ')}    {name} = {status.number}" for name, status in named
    ]
    joined = ",\n".join(lines)
    cases = "".join(f'    case {name}:\n        return "{status.name}";\n' for name, status in named)
    return CFragment(
        "/* Statuses of the compensator at its last command. */\n",
        f"enum {{\n{joined}\n}};\n\n"
        '/* Return the name of the status with this number; "" if there is no such status. */\n'
        "const char *jaxhil_law_status_name(int status);\n",
        "const char *jaxhil_law_status_name(int status) {\n    switch (status) {\n"
        f'{cases}    default:\n        return "";\n    }}\n}}\n',
    )


def constants_check() -> str:
    """Return a C function that checks the constants of a six-axis controller, such as the mass matrix."""
    lowest, highest = (format_double(bound) for bound in MATRIX_ENTRIES)
    return (
        "static bool jaxhil_constants_fit(const jaxhil_constants *constants) {\n"
        "    bool fit = constants->longest_delay >= 0.0 && isfinite(constants->longest_delay);\n"
        "    fit = fit && fabs(constants->sensor_sign) == 1.0;\n"
        "    for (int i = 0; i < 6; i++) {\n"
        "        for (int j = 0; j < 6; j++) {\n"
        + "".join(
            f"            fit = fit && constants->{name}[i][j] >= {lowest} &&\n"
            f"                  constants->{name}[i][j] <= {highest};\n"
            for name in ("mass_matrix", "inverse_mass", "tool_correction")
        )
        + "        }\n"
        f"        fit = fit && constants->tool_load[i] >= {lowest} && constants->tool_load[i] <= {highest};\n"
        "        fit = fit && constants->mass_matrix[i][i] > 0.0 && constants->inverse_mass[i][i] > 0.0;\n"
        "    }\n"
        "    return fit;\n"
        "}\n"
    )


def gain_file_constants(gain_file: Any, kind: ControllerKind) -> str:
    """Return C constants with a gain file's content: gains, limits and, for six axes, model constants."""
    specifications = kind.compensators[gain_file.compensator].gains
    units = {"control_period": "s", **({"clearance": "m"} if kind.axes == 1 else {})}
    units |= {name: gain.unit for name, gain in specifications.items()}
    gains = {name: getattr(gain_file, name) for name in units if name not in specifications}
    gains |= {name: gain_file.gains[name] for name in specifications}
    limits = {name: gain_file.limits[name] for name in kind.limits}
    limit_units = {name: limit.unit for name, limit in kind.limits.items()}
    text = (
        f"static const jaxhil_gains jaxhil_exported_gains = {{\n{_initialisers(gains, units)}}};\n\n"
        f"static const jaxhil_limits jaxhil_exported_limits = {{\n{_initialisers(limits, limit_units)}}};\n"
    )
    return text if kind.axes == 1 else f"{text}\n{_model_constants(gain_file.constants)}"


def _model_constants(constants: Any) -> str:
    """Return a C struct with the constants of a six-axis controller, such as the mass matrix."""
    lines = []
    for name, value in constants._asdict().items():
        if isinstance(value, float):
            lines.append(f"    {format_double(value)}, /* {name} */\n")
        elif isinstance(value[0], float):
            lines.append(f"    {{{_row(value)}}}, /* {name} */\n")
        else:
            joined = ",\n".join(f"        {{{_row(row)}}}" for row in value)
            lines.append(f"    /* {name} */\n    {{\n{joined}\n    }},\n")
    return f"static const jaxhil_constants jaxhil_exported_constants = {{\n{''.join(lines)}}};\n"


def _row(values: Sequence[float]) -> str:
    """Return C literals, separated by commas."""
    return ", ".join(format_double(value) for value in values)


def _initialisers(values: Mapping[str, float], units: Mapping[str, str]) -> str:
    """Return the C initialisers of a struct's fields, in order; initialisers with names require C++20."""
    return "".join(
        f"    {format_double(value)}, /* {name}, {units[name]} */\n" for name, value in values.items()
    )


def _define_struct(name: str, entries: Iterable[tuple[str, str]]) -> str:
    """Return the C definition of a struct of doubles; `entries` are names and comments of the fields."""
    lines = "".join(f"{_format_comment(meaning, '    ')}    double {entry};\n" for entry, meaning in entries)
    return f"typedef struct {{\n{lines}}} {name};\n"


def _range_condition(name: str, lowest: float, highest: float, struct: str = "gains") -> str:
    """Return the C condition that a field is within its range and, if a bound is infinite, finite."""
    open_below, open_above = math.isinf(lowest), math.isinf(highest)
    conditions = [f"isfinite({struct}->{name})"] * (open_below or open_above)
    conditions += [] if open_below else [f"{struct}->{name} >= {format_double(lowest)}"]
    conditions += [] if open_above else [f"{struct}->{name} <= {format_double(highest)}"]
    return " && ".join(conditions)


def _check_function(function: str, struct: str, argument: str, checks: Iterable[str]) -> str:
    """Return a C function that returns true if a struct satisfies all conditions `checks`."""
    joined = " &&\n           ".join(checks)
    return f"static bool {function}(const {struct} *{argument}) {{\n    return {joined};\n}}\n"


def _format_comment(text: str, indent: str) -> str:
    """Return `text` as a C comment, wrapped and indented."""
    lines = textwrap.wrap(text, MAX_LINE_WIDTH - len(indent) - 6, break_long_words=False)
    return f"{indent}/* {f'{chr(10)}{indent} * '.join(lines)} */\n"
