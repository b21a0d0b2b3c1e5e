"""The controller in C99: from a gain document to the sources that a rig computer compiles.

The sources stand as fragments in `jaxhil/c99`, the laws' in `laws`, one file per subject, as in the Python
runtime. A fragment opens with a comment and its `#include` lines; `/* == Declarations == */` begins what goes
into the header, if anything does, `/* == Definitions == */` what goes into the source. It includes the
fragments that it needs by name; `law.c` stands for the exported law's own file, which has the law's name,
`..._table.c` for what `c99_tables` makes of the runtime's tables. Where a fragment sizes an array by
`JAXHIL_<NAME>_SAMPLES`, that constant is the length of a line which delays by the gain or limit of that name.
"""

import math
import re
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any, NamedTuple

from jaxhil.errors import InputError, one_line
from jaxhil.runtime.controller import Controller
from jaxhil.runtime.gain_file import GainFile, check_gain_document
from jaxhil.runtime.laws import WITHOUT_C
from tuning.bundle.c99_tables import Table, constants, faults_table, gains_table, limits_table, statuses_table

HEADER, SOURCE = "jaxhil_controller.h", "jaxhil_controller.c"
GAINS, TEST = "jaxhil_gains.h", "test_vectors.c"
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
DECLARATIONS = "/* == Declarations == */\n"
DEFINITIONS = "/* == Definitions == */\n"
LAW = "law.c"
FOLDER = resources.files("jaxhil") / "c99"

_INCLUDE = re.compile(r'^#include ([<"])([a-z0-9_]+\.[ch])[>"]\n', re.MULTILINE)
_SAMPLES = re.compile(r"\bJAXHIL_([A-Z0-9_]+)_SAMPLES\b")

_HEADER = """\
/* The controller of a hardware-in-the-loop docking rig, with the compensator `{law}`.
 *
 * C99, no allocation, no library but math.h. The caller owns the struct:
 *
 *     static jaxhil_controller controller;
 *     jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits);
 *
 * Compile with -ffp-contract=off (and never -ffast-math, nor a part of it): the results then are those of the
 * runtime in Python bit for bit, which test_vectors.c checks. The headers are C++ too, from C++11 on.
 */
#ifndef JAXHIL_CONTROLLER_H
#define JAXHIL_CONTROLLER_H

#include <float.h>
{includes}
#if defined(__FAST_MATH__) || defined(_M_FP_FAST)
#error "-ffast-math loses what is not finite, and the controller with it (of MSVC: /fp:precise)"
#endif
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "-ffinite-math-only loses what is not finite, and the controller with it"
#endif
#if defined(__ASSOCIATIVE_MATH__) || defined(__RECIPROCAL_MATH__)
#error "-fassociative-math and -freciprocal-math compute something else"
#endif
#if FLT_RADIX != 2 || DBL_MANT_DIG != 53 || DBL_MAX_EXP != 1024
#error "a double has to be one of IEEE 754"
#endif
#if FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 1
#error "a double has to be computed as one (on a 32-bit x86: -msse2 -mfpmath=sse)"
#endif
{lengths}
#ifdef __cplusplus
extern "C" {{
#endif

{declarations}
#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """\
/* See jaxhil_controller.h. */
#include "jaxhil_controller.h"

/* No a * b + c with one rounding. GCC does not know the pragma of C99, and warns of it. */
#if defined(_MSC_VER) && !defined(__clang__)
#pragma fp_contract(off)
#elif defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=off")
#else
#pragma STDC FP_CONTRACT OFF
#endif

{definitions}"""

_GAINS = """\
/* Gains of the compensator `{law}` and limits, from the gain file whose content has the SHA-256
 * {digest}.
 * Decimal, 17 significant digits: a compiler reads back the same doubles.
 */
#ifndef JAXHIL_GAINS_H
#define JAXHIL_GAINS_H

#include <math.h>

#include "jaxhil_controller.h"

{constants}
#endif
"""


_TABLES: Mapping[str, Callable[[str], Table]] = {
    "gains_table.c": gains_table,
    "limits_table.c": lambda law: limits_table(),
    "faults_table.c": lambda law: faults_table(),
    "law_status_table.c": lambda law: statuses_table(),
}


class _Fragment(NamedTuple):
    """A part of the C sources."""

    system: tuple[str, ...]  # the headers that it includes, as `math.h`
    local: tuple[str, ...]  # the fragments that it includes
    declarations: str  # what it adds to the header, "" or a newline if nothing
    definitions: str  # what it adds to the source, likewise


def c99_texts(document: Mapping[str, Any], source: str = "gain document") -> dict[str, str]:
    """The files of the controller in C99 by name: header, source, gains, test program.

    Raises GainFileError for a document that the runtime refuses, InputError for a compensator that has no
    C file. Same document, same texts.
    """
    gain_file = check_gain_document(document, source)
    Controller(gain_file, source)  # refuses delays that no line can hold
    law = gain_file.compensator
    if law in WITHOUT_C:
        raise InputError(f"c99: found {law}, which has no C99 sources yet; expected the other formats")
    fragments = _in_order("controller.c", law)
    declarations = "\n".join(part for fragment in fragments if (part := fragment.declarations).strip())
    definitions = "\n".join(part for fragment in fragments if (part := fragment.definitions).strip())
    system = sorted({name for fragment in fragments for name in fragment.system} - {"float.h"})
    return {
        HEADER: _HEADER.format(
            law=law,
            includes="".join(f"#include <{name}>\n" for name in system),
            lengths=_lengths(declarations, gain_file),
            declarations=declarations,
        ),
        SOURCE: _SOURCE.format(definitions=definitions),
        GAINS: _GAINS.format(law=law, digest=document["sha256"], constants=constants(gain_file)),
        TEST: _read(TEST),
    }


def _in_order(root: str, law: str) -> list[_Fragment]:
    """The fragment `root` and what it needs, each after what it includes itself."""
    found: dict[str, _Fragment] = {}
    visited: set[str] = set()

    def visit(name: str) -> None:
        if name in visited:
            return
        visited.add(name)
        fragment = _fragment(name, law)
        for needed in fragment.local:
            visit(f"{law}.c" if needed == LAW else needed)
        found[name] = fragment

    visit(root)
    return list(found.values())


def _fragment(name: str, law: str) -> _Fragment:
    if name in _TABLES:
        comment, declarations, definitions = _TABLES[name](law)
        return _Fragment(("math.h", "stdbool.h", "stdint.h"), (), f"{comment}\n{declarations}", definitions)
    before, marked, definitions = _read(name).partition(DEFINITIONS)
    if not marked:
        raise InputError(f"jaxhil/c99/{name}: found no definitions, allowed {DEFINITIONS.strip()}")
    head, _, declarations = before.partition(DECLARATIONS)
    includes = _INCLUDE.findall(head)
    comment = _INCLUDE.sub("", head).strip() + "\n"
    parts = [declarations.strip("\n"), definitions.strip("\n")]
    # The comment opens what there is: most fragments declare something.
    first = 0 if parts[0] else 1
    parts[first] = f"{comment}\n{parts[first]}"
    return _Fragment(
        tuple(file for mark, file in includes if mark == "<"),
        tuple(file for mark, file in includes if mark == '"'),
        *(f"{part}\n" for part in parts),
    )


def _read(name: str) -> str:
    for folder in (FOLDER, FOLDER / "laws"):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8")
    raise InputError(one_line(f"jaxhil/c99/laws/{name}: found no such file, allowed one per law"))


def _lengths(declarations: str, gain_file: GainFile) -> str:
    lines = []
    delays = {**gain_file.limits, **gain_file.gains}
    for name in dict.fromkeys(_SAMPLES.findall(declarations)):
        whole = math.floor(delays[name.lower()] / gain_file.control_period + 1e-9)
        lines.append(
            f"\n/* Samples of the line that delays by `{name.lower()}`: raise it to load longer delays. */\n"
            f"#define JAXHIL_{name}_SAMPLES {whole + 2}\n"
        )
    return "".join(lines)
