"""Element-wise primitives as C expressions, and the C functions that these expressions call."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from tuning.bundle.jaxpr_c.values import C_TYPES, UnsupportedProgram, Value

Expression = Callable[..., str]
INTEGERS = ("int32", "uint32", "int64", "uint64")
# Functions of math.h with the name of the primitive.
SAME_NAMES = (
    *("exp", "exp2", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh"),
    *("acosh", "atanh", "log1p", "expm1", "erf", "erfc", "cbrt", "sqrt", "floor", "ceil", "atan2"),
    *("pow", "nextafter"),
)
COMPARISONS = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
FLOATS: dict[str, str] = {
    **{
        name: f"{name}({{0}}{', {1}' if name in ('atan2', 'pow', 'nextafter') else ''})"
        for name in SAME_NAMES
    },
    "add": "{0} + {1}",
    "add_any": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "rem": "fmod({0}, {1})",
    "neg": "-{0}",
    "abs": "fabs({0})",
    "square": "{0} * {0}",
    "rsqrt": "1.0 / sqrt({0})",
    "logistic": "1.0 / (1.0 + exp(-{0}))",
    "sign": "sign_of({0})",
    "max": "larger_of({0}, {1})",
    "min": "smaller_of({0}, {1})",
    "clamp": "smaller_of(larger_of({0}, {1}), {2})",
    "is_finite": "isfinite({0})",
    "erf_inv": "inverse_erf({0})",
}
BOOLEANS: dict[str, str] = {
    "and": "{0} && {1}",
    "or": "{0} || {1}",
    "xor": "{0} != {1}",
    "not": "!{0}",
    "max": "{0} || {1}",
    "min": "{0} && {1}",
}
UNSIGNED: dict[str, str] = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "neg": "0u - {0}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "xor": "{0} ^ {1}",
    "not": "~{0}",
    "shift_left": "{1} < {bits} ? {0} << {1} : 0u",
    "shift_right_logical": "{1} < {bits} ? {0} >> {1} : 0u",
}
# Operations of signed integers that are computed with unsigned ones, so that they wrap around.
WRAPPED = ("add", "sub", "mul", "neg", "shift_left", "shift_right_logical")
SIGNED: dict[str, str] = {
    **{name: UNSIGNED[name] for name in ("and", "or", "xor", "not")},
    "abs": "{0} < 0 ? ({type})(0u - ({unsigned}){0}) : {0}",
    "sign": "({0} > 0) - ({0} < 0)",
}
ORDERED: dict[str, str] = {
    "max": "{0} > {1} ? {0} : {1}",
    "min": "{0} < {1} ? {0} : {1}",
    "clamp": "{1} < {0} ? {0} : {1} > {2} ? {2} : {1}",
    "div": "{1} == 0 ? ({type})-1 : {minus_one}{0} / {1}",
    "rem": "{1} == 0 ? {0} : {minus_one_zero}{0} % {1}",
}

HELPERS = {
    "larger_of": """\
/* The larger number; NaN if one of them is NaN. */
static double larger_of(double a, double b) {
    if (isnan(a) || isnan(b)) {
        return NAN;
    }
    return a > b || (a == b && !signbit(a)) ? a : b;
}
""",
    "smaller_of": """\
/* The smaller number; NaN if one of them is NaN. */
static double smaller_of(double a, double b) {
    if (isnan(a) || isnan(b)) {
        return NAN;
    }
    return a < b || (a == b && signbit(a)) ? a : b;
}
""",
    "sign_of": """\
static double sign_of(double a) {
    return a > 0.0 ? 1.0 : a < 0.0 ? -1.0 : a;
}
""",
    "inverse_erf": """\
/* Inverse of the error function: start value by Winitzki 2008, then two steps of Halley's method. */
static double inverse_erf(double a) {
    const double rest = 1.0 - fabs(a), half_root_of_pi = 0.88622692545275801;
    double series, part, root;
    if (!(rest > 0.0) || a == 0.0) {
        return rest == 0.0 ? copysign(INFINITY, a) : rest < 0.0 ? NAN : a;
    }
    series = log1p(-a * a);
    part = 4.3307467508 + series / 2.0;
    root = sqrt(sqrt(part * part - series / 0.147) - part);
    for (int n = 0; n < 2; n++) {
        const double error = (rest - erfc(root)) * half_root_of_pi * exp(root * root);
        const double small = (erf(root) - fabs(a)) * half_root_of_pi * exp(root * root);
        const double step = fabs(a) < 0.5 ? small : error;
        root -= step / (1.0 + root * step);
    }
    return copysign(root, a);
}
""",
    "to_int32": """\
/* The integer towards zero; the nearest integer of the type beyond its range, and 0 for NaN. */
static int32_t to_int32(double a) {
    return isnan(a) ? 0 : a >= 2147483647.0 ? 2147483647 : a <= -2147483648.0 ? -2147483647 - 1 : (int32_t)a;
}
""",
    "to_int64": """\
static int64_t to_int64(double a) {
    if (isnan(a)) {
        return 0;
    }
    return a >= 9223372036854775808.0 ? INT64_MAX : a < -9223372036854775808.0 ? INT64_MIN : (int64_t)a;
}
""",
    "to_uint32": """\
static uint32_t to_uint32(double a) {
    return !(a > 0.0) ? 0u : a >= 4294967295.0 ? 4294967295u : (uint32_t)a;
}
""",
    "clamp_index": """\
/* The start index of a slice that lies within an array. */
static int64_t clamp_index(int64_t index, int64_t highest) {
    return index < 0 ? 0 : index > highest ? highest : index;
}
""",
}


def expression(name: str, params: dict[str, Any], values: Sequence[Value]) -> Expression | None:
    """Return a function that writes a JAX primitive in C; its arguments are elements of the operands.

    Args:
        name: name of the primitive.
        params: parameters of the primitive.
        values: operands.

    Returns:
        The function; None if the primitive is not element-wise, or not known for operands of this type.
    """
    if name == "select_n":
        return _select(values)
    if name == "convert_element_type":
        return lambda element: _convert(element, values[0].type, str(np.dtype(params["new_dtype"])))
    if name == "integer_pow":
        return lambda element: _power(element, params["y"], values[0].type)
    type_name = values[0].type if name != "clamp" else values[1].type
    if name in COMPARISONS:
        return f"{{0}} {COMPARISONS[name]} {{1}}".format
    if name == "round":
        nearest = params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
        return ("nearbyint({0})" if nearest else "round({0})").format
    if type_name in INTEGERS:
        return _integer(name, type_name)
    template = (FLOATS if type_name == "float64" else BOOLEANS).get(name)
    return None if template is None else template.format


def _integer(name: str, type_name: str) -> Expression | None:
    bits, is_signed = int(type_name[-2:]), type_name[0] == "i"
    signed, unsigned = C_TYPES[type_name], f"uint{bits}_t"
    words: dict[str, Any] = {
        "bits": bits,
        "type": signed,
        "unsigned": unsigned,
        "minus_one": "",
        "minus_one_zero": "",
    }
    if is_signed:
        words["minus_one"] = f"{{1}} == -1 ? ({signed})(0u - ({unsigned}){{0}}) : "
        words["minus_one_zero"] = "{1} == -1 ? 0 : "
    if is_signed and name in WRAPPED:
        template = UNSIGNED[name]
        return lambda *parts: (
            f"({signed})({template.format(*(f'({unsigned}){part}' for part in parts), **words)})"
        )
    template = ORDERED.get(name) or (SIGNED if is_signed else UNSIGNED).get(name)
    if template is None:
        return None
    for word in ("minus_one", "minus_one_zero"):
        template = template.replace(f"{{{word}}}", words[word])
    return lambda *parts: template.format(*parts, **words)


def _select(values: Sequence[Value]) -> Expression:
    """Return a function that writes the C expression for selecting a case by a boolean or an integer."""
    if values[0].type == "bool":
        return "{0} ? {2} : {1}".format
    tests = "".join(f"{{0}} == {n} ? {{{n + 1}}} : " for n in range(len(values) - 2))
    return f"{tests}{{{len(values) - 1}}}".format


def _convert(element: str, old: str, new: str) -> str:
    if new not in C_TYPES:
        raise UnsupportedProgram(f"type: found {new}, expected one of {', '.join(C_TYPES)}")
    if old == new:
        return element
    if new == "bool":
        return f"{element} != 0"
    if old == "float64":
        if f"to_{new}" not in HELPERS:
            raise UnsupportedProgram(
                f"conversion: found float64 to {new}, expected to int32, uint32 or int64"
            )
        return f"to_{new}({element})"
    return f"({C_TYPES[new]}){element}"


def _power(element: str, exponent: int, type_name: str) -> str:
    """Return the C expression of an integer power, with its products in the order of repeated squaring."""
    if type_name != "float64":
        raise UnsupportedProgram(f"integer_pow: found {type_name}, expected float64")
    if exponent == 0:
        return "1.0"
    count, factors, square = abs(exponent), [], element
    while count:
        if count % 2:
            factors.append(square)
        square, count = f"({square} * {square})", count // 2
    product = " * ".join(factors)
    return product if exponent > 0 else f"1.0 / ({product})"
