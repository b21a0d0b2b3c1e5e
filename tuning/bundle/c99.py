"""Generation of the controller's C99 source files from a gain document, for a compiler on the rig computer.

`jaxhil.codegen` translates the Python code of the controller, its guards and the compensator. This module and
`c99_tables` add three more parts: checks of the compiler's options; tables of gains, limits, faults and
statuses; and the function `jaxhil_init`, which checks gains and limits. The test program is `test_vectors.c`.
A constant `JAXHIL_<CLASS>_<ATTRIBUTE>` is the capacity of a list whose length depends on gains or limits.
"""

import functools
import inspect
from collections.abc import Mapping
from importlib import resources
from typing import Any

from jaxhil.codegen import CProgram, SubsetError
from jaxhil.errors import InputError, to_one_line
from jaxhil.rig.law_status import STATUSES, ContactCount
from tuning.bundle.c99_tables import (
    NO_CONTRACTION,
    UNUSABLE,
    constants_check,
    faults_fragment,
    gain_file_constants,
    gains_fragment,
    limits_fragment,
    statuses_fragment,
)
from tuning.bundle.controller_kind import ONE_AXIS, ControllerKind, kind_of

HEADER_FILE, SOURCE_FILE = "jaxhil_controller.h", "jaxhil_controller.c"
GAINS_FILE, TEST_FILE = "jaxhil_gains.h", "test_vectors.c"
COMPILER_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")

_TESTED_CONTROLLER = """\
#include "jaxhil_controller.h"
#include "jaxhil_gains.h"

static jaxhil_controller controller;
"""

_HEADER_TEMPLATE = """\
/* Controller of a hardware-in-the-loop docking rig, with the compensator `{law}`.
 *
 * It is written in C99, allocates no memory, and uses no library but math.h. The caller owns the struct:
 *
 *     static jaxhil_controller controller;
 *     jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits{exported});
 *
 * Compile with -ffp-contract=off, and never with -ffast-math or a part of it. Then the results equal those of
 * the Python runtime to the last bit, which test_vectors.c checks. The headers are also valid C++ (C++11).
 */
#ifndef JAXHIL_CONTROLLER_H
#define JAXHIL_CONTROLLER_H

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if defined(__FAST_MATH__) || defined(_M_FP_FAST)
#error "do not use -ffast-math: the controller needs NaN and infinity (MSVC: use /fp:precise)"
#endif
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "do not use -ffinite-math-only: the controller needs NaN and infinity"
#endif
#if defined(__ASSOCIATIVE_MATH__) || defined(__RECIPROCAL_MATH__)
#error "do not use -fassociative-math or -freciprocal-math: they change the results"
#endif
#if FLT_RADIX != 2 || DBL_MANT_DIG != 53 || DBL_MAX_EXP != 1024
#error "double must be the 64-bit format of IEEE 754"
#endif
#if FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 1
#error "double must be computed in double precision (32-bit x86: use -msse2 -mfpmath=sse)"
#endif
{capacities}
#ifdef __cplusplus
extern "C" {{
#endif

{declarations}
#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE_TEMPLATE = """\
/* See jaxhil_controller.h. */
#include "jaxhil_controller.h"

{contraction}
{definitions}"""

_GAINS_TEMPLATE = """\
/* Gains of the compensator `{law}` and limits, from the gain file whose content has the SHA-256
 * {digest}.
 * A compiler reads the same doubles from the numbers, which have 17 significant digits.
 */
#ifndef JAXHIL_GAINS_H
#define JAXHIL_GAINS_H

#include <math.h>

#include "jaxhil_controller.h"

{constants}
#endif
"""


_PROTOTYPES_TEMPLATE = """
/* Initialise the controller with these {structs}. Return false if a value is out of its range, or if a
 * delay is longer than the delay lines of this code: the controller then stays tripped, with the cause
 * JAXHIL_UNUSABLE. */
bool jaxhil_init(jaxhil_controller *controller, const jaxhil_gains *gains, const jaxhil_limits *limits{more});
"""

_IDENTIFIED_PROTOTYPE = """
/* Get the identified stiffness [N/m] and damping [N s/m]; both are 0 without an identification. */
void jaxhil_identified(const jaxhil_controller *controller, double *stiffness, double *damping);
"""

_INIT_TEMPLATE = """
static void jaxhil_clear(jaxhil_controller *controller) {{
    unsigned char *bytes = (unsigned char *)controller;
    for (size_t n = 0; n < sizeof *controller; n++) {{
        bytes[n] = 0;
    }}
}}

bool jaxhil_init(jaxhil_controller *controller, const jaxhil_gains *gains,
                 const jaxhil_limits *limits{more}) {{
    bool error = !(jaxhil_gains_admitted(gains) && jaxhil_limits_fit(limits){admitted});
    jaxhil_clear(controller);
    if (!error) {{
        jaxhil_law_init(&controller->law, gains, {law_arguments}{law_error});
    }}
    if (!error) {{
        jaxhil_controller_guard(controller, limits, {guard_arguments}{guard_error});
    }}
    if (error) {{
        {ignored}jaxhil_clear(controller);
        jaxhil_controller_guard(controller, &jaxhil_no_limits, {unusable_arguments}{ignored_error});
        jaxhil_controller_fail(controller, JAXHIL_UNUSABLE);{unstated}
    }}
    return !error;
}}
"""

_IDENTIFIED = """
void jaxhil_identified(const jaxhil_controller *controller, double *stiffness, double *damping) {
    double identified[2];
    jaxhil_controller_identified(controller, identified);
    *stiffness = identified[0];
    *damping = identified[1];
}
"""


def generate_c99(document: Mapping[str, Any], source: str = "gain document") -> dict[str, str]:
    """Generate the C99 files of the controller: header, source, gains and test program.

    Equal documents give equal files.

    Args:
        document: gain document.
        source: label of the document in error messages.

    Returns:
        Text of each file by its name.

    Raises:
        GainFileError: If the runtime rejects the document.
        InputError: If the compensator contains Python code that cannot be translated to C. The message names
            file and line.
    """
    kind = kind_of(document)
    gain_file = kind.check_document(document, source)
    controller = kind.controller(gain_file, source)  # raises an error if a delay is too long for a delay line
    law = gain_file.compensator
    program, declarations, definitions = _generate_code(law, kind.compensators[law], kind.axes)
    comment = "/* Capacity of this list in its struct; increase it for longer delays. */"
    lengths = program.capacities(controller, kind.controller)
    capacities = [f"\n{comment}\n#define {name} {length}\n" for name, length in lengths.items()]
    return {
        HEADER_FILE: _HEADER_TEMPLATE.format(
            law=law,
            capacities="".join(capacities),
            declarations=declarations,
            exported="" if kind is ONE_AXIS else ",\n *                 &jaxhil_exported_constants",
        ),
        SOURCE_FILE: _SOURCE_TEMPLATE.format(contraction=NO_CONTRACTION, definitions=definitions),
        GAINS_FILE: _GAINS_TEMPLATE.format(
            law=law, digest=document["sha256"], constants=gain_file_constants(gain_file, kind)
        ),
        TEST_FILE: test_program(_TESTED_CONTROLLER, _read_text(kind.test_program)),
    }


def test_program(controller: str, columns: str) -> str:
    """Return the C program that replays the test vectors of vectors.csv.

    Args:
        controller: C code that includes the controller's headers and declares the controller.
        columns: C code that defines the columns of the file, and the functions that call the controller.
    """
    text = _read_text(TEST_FILE)
    return text.replace("@controller@\n", controller).replace("@columns@\n", columns)


def _read_text(file: str) -> str:
    return (resources.files("tuning") / "bundle" / file).read_text(encoding="utf-8")


@functools.cache
def _generate_code(law: str, class_: type[Any], axes: int) -> tuple[CProgram, str, str]:
    """Return a controller's C program, the text of its declarations, and the text of its definitions."""
    kind = kind_of({"axes": axes})
    members = {name: inspect.getattr_static(kind.controller, name) for name in kind.methods}
    functions: dict[str, Any] = {
        name: member.fget if isinstance(member, property) else member for name, member in members.items()
    }
    program = _program(class_, kind, functions)
    try:
        constructor = program.add(class_.__init__, class_)
        guard = program.add(vars(kind.controller)["_guard"], kind.controller)
        for function in functions.values():
            program.add(function, kind.controller)
        if kind is ONE_AXIS:
            program.add(vars(kind.controller)["identified"].fget, kind.controller)
        output = program.output()
    except SubsetError as error:
        raise InputError(
            to_one_line(f"c99: {law}: {error}; use `--format csv` to export without C code")
        ) from None
    tables = [
        gains_fragment(law, kind), limits_fragment(kind), faults_fragment(kind.faults), statuses_fragment(),
    ]  # fmt: skip
    declared = "\n".join(f"{table.comment}\n{table.declarations}" for table in tables)
    defined = "\n".join(table.definitions for table in tables if table.definitions)
    if kind.constants is not None:
        defined = f"{defined}\n{constants_check()}"
    has_status = "status" in program.fields.get(class_, {})  # otherwise the status is a constant
    prototypes, init = _initialisation(kind, constructor.fails, guard.fails, has_status)
    definitions = f"{defined}\n{output.definitions}{init}"
    return program, f"{declared}{output.declarations}{prototypes}", definitions


def _program(class_: type[Any], kind: ControllerKind, functions: Mapping[str, Any]) -> CProgram:
    """Return a C program without functions, for a controller with the compensator `class_`."""
    enumerators = {fault.name.upper(): fault.bit for fault in kind.faults} | {"UNUSABLE": UNUSABLE}
    enumerators |= {status.name.upper(): status.number for status in STATUSES}
    return CProgram(
        "jaxhil_",
        structs={
            "gains": {name: gain.lowest for name, gain in class_.gains.items()},
            "limits": {name: limit.lowest for name, limit in kind.limits.items()},
        },
        names={class_: "law", ContactCount: "contact_record", **kind.c_names},
        public={functions[name]: f"jaxhil_{c_name}" for name, c_name in kind.methods.items()},
        bindings={kind.protocol: class_},
        enumerators=enumerators,
    )


def _initialisation(
    kind: ControllerKind, law_fails: bool, guard_fails: bool, has_status: bool
) -> tuple[str, str]:
    """Return prototypes and definitions of `jaxhil_init` and, on one axis, `jaxhil_identified`.

    Args:
        kind: kind of controller.
        law_fails: whether the compensator's constructor may fail; its C function then has an error argument.
        guard_fails: the same for the controller's method `_guard`.
        has_status: whether the compensator has a status.
    """
    is_one_axis = kind is ONE_AXIS
    period, clearance = "gains->control_period", ", gains->clearance"
    more = "" if is_one_axis else ",\n                 const jaxhil_constants *constants"
    init = _INIT_TEMPLATE.format(
        more=more,
        admitted="" if is_one_axis else " && jaxhil_constants_fit(constants)",
        law_arguments=f"{period}{clearance}" if is_one_axis else f"*constants, {period}",
        law_error=", &error" * law_fails,
        guard_arguments=f"{period}{clearance}" if is_one_axis else f"*constants, {period}",
        guard_error=", &error" * guard_fails,
        unusable_arguments="1.0, INFINITY" if is_one_axis else "*constants, 1.0",
        ignored="bool ignored = false;\n        " * guard_fails,
        ignored_error=", &ignored" * guard_fails,
        unstated="\n        controller->law.status = JAXHIL_UNSTATED;" * has_status,
    )
    structs = "gains and limits" if is_one_axis else "gains, limits and constants"
    prototypes = _PROTOTYPES_TEMPLATE.format(more=more, structs=structs)
    if is_one_axis:
        return f"{prototypes}{_IDENTIFIED_PROTOTYPE}", f"{init}{_IDENTIFIED}"
    return prototypes, init
