"""Sources of the C99 controller: no warnings, no static memory, no unused exports."""

import functools
import inspect
import platform
import re
import shutil
import subprocess
from typing import ClassVar

import c99_cases
import numpy as np
import pytest
from c99_cases import (
    compiled,
)
from gain_documents import gain_document, sign

from jaxhil.errors import InputError
from jaxhil.rig import COMPENSATORS, GainFileError
from jaxhil.rig.gain_file import check_gain_document
from jaxhil.rig.registry import Compensator, GainSpecification
from tuning.bundle.c99 import generate_c99

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
LAWS = tuple(COMPENSATORS)


@pytest.fixture(scope="module")
def controller_object(tmp_path_factory):
    """Return `controller_object(law)`: the folder with the compensator's sources and its controller.o."""

    @functools.cache
    def made(law):
        folder = c99_cases.write_sources(tmp_path_factory.mktemp(law), gain_document(law))
        strict = ("-Wconversion", "-Wshadow", "-Wstrict-prototypes", "-Wfloat-conversion")
        compiled(folder, "jaxhil_controller.c", "controller.o", "-c", "-O2", *strict)
        return folder

    return made


@pytest.mark.parametrize("law", LAWS)
def test_c99_compensators_compile_without_warnings(law, controller_object):
    compiled(controller_object(law), "test_vectors.c", "test.o", "-c", "-O0")


@pytest.mark.parametrize("law", LAWS)
def test_c99_controller_has_no_static_data_and_calls_only_math_functions(law, controller_object):
    if shutil.which("nm") is None:
        pytest.skip("no nm on this machine")
    folder = controller_object(law)
    listed = subprocess.run(["nm", "-P", "controller.o"], cwd=folder, capture_output=True, text=True).stdout
    symbols = [line.split()[:2] for line in listed.splitlines()]
    # Compilers turn loops and assignments into memset, memcpy and memmove, also in a free-standing program.
    wanted = {name for name, kind in symbols if kind == "U"}
    assert wanted <= {
        "ceil",
        "exp",
        "floor",
        "log",
        "pow",
        "sqrt",
        "memset",
        "memcpy",
        "memmove",
        "_GLOBAL_OFFSET_TABLE_",
        "__stack_chk_fail",
    }
    assert not [name for name, kind in symbols if kind in "BbDdC"]
    visible = {name for name, kind in symbols if kind == "T"}
    assert {"jaxhil_init", "jaxhil_step"} <= visible
    assert all(name.startswith("jaxhil_") for name in visible)


def compilers(*names: str):
    """Run a test with each of these compilers; skip compilers that are not installed."""
    cases = [
        pytest.param(name, marks=pytest.mark.skipif(shutil.which(name) is None, reason=f"no {name} here"))
        for name in names
    ]
    return pytest.mark.parametrize("compiler", cases)


USE = """\
#include "jaxhil_controller.h"
#include "jaxhil_gains.h"
static jaxhil_controller controller;
int main(void) {
    return jaxhil_init(&controller, &jaxhil_exported_gains, &jaxhil_exported_limits) ? 0 : 1;
}
"""


@compilers("g++", "clang++")
@pytest.mark.parametrize("standard", ["c++11", "c++17"])
def test_c99_headers_compile_in_cpp(compiler, standard, tmp_path):
    """Build as ROS 2 does: controller in C, caller in C++."""
    folder = c99_cases.write_sources(tmp_path, gain_document())
    (folder / "use.cpp").write_text(USE)
    controller = compiled(folder, "jaxhil_controller.c", "controller.o", "-c", "-O2")
    flags = [f"-std={standard}", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    command = [compiler, *flags, "use.cpp", str(controller), "-lm", "-o", "use"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert subprocess.run([str(folder / "use")]).returncode == 0


@compilers("gcc", "clang")
@pytest.mark.parametrize("standard", ["c99", "gnu99", "c11", "gnu17"])
def test_c99_sources_compile_without_warnings(compiler, standard, tmp_path):
    folder = c99_cases.write_sources(tmp_path, gain_document())
    for source in ("jaxhil_controller.c", "test_vectors.c"):
        command = [compiler, f"-std={standard}", "-O2", "-Wall", "-Wextra", "-pedantic", "-c", source]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert (ran.returncode, ran.stderr) == (0, "")


@compilers("gcc", "clang")
@pytest.mark.parametrize(
    "flags",
    [
        ["-ffast-math"],
        ["-Ofast"],
        ["-ffinite-math-only"],
        ["-D_M_FP_FAST"],  # macro of MSVC
        ["-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math"],
        ["-freciprocal-math"],
    ],
    ids=lambda flags: flags[0],
)
def test_c99_header_rejects_unsafe_math_flags(compiler, flags, tmp_path):
    folder = c99_cases.write_sources(tmp_path, gain_document())
    macros = subprocess.run(
        [compiler, *flags, "-dM", "-E", "-"], input="", capture_output=True, text=True
    ).stdout
    if not re.search(r"FAST_MATH__|FINITE_MATH_ONLY__ 1|_M_FP_FAST|ASSOCIATIVE|RECIPROCAL", macros):
        pytest.skip("this compiler does not tell the code")
    command = [compiler, "-std=c99", *flags, "-fsyntax-only", "test_vectors.c"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert ran.returncode != 0 and re.search("error.*math", ran.stderr)


@compilers("gcc", "clang")
def test_c99_multiplication_and_addition_are_never_fused(compiler, tmp_path):
    """The compiler flags allow fused multiply-add; the sources must prevent it."""
    if platform.machine() != "x86_64":
        pytest.skip("the names of the instructions are those of x86")
    folder = c99_cases.write_sources(tmp_path, gain_document())
    fusing = ["-std=gnu99", "-O2", "-mfma", "-S", "-o", "-"]
    (folder / "fused.c").write_text("double f(double a, double b, double c) { return a * b + c; }\n")
    probe = subprocess.run([compiler, *fusing, "fused.c"], cwd=folder, capture_output=True, text=True)
    assert "vfmadd" in probe.stdout
    ran = subprocess.run(
        [compiler, *fusing, "jaxhil_controller.c"], cwd=folder, capture_output=True, text=True
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    # GCC 12 vectorises 2 a + b and 2 a - b to vfmaddsub despite the flags; that is harmless: 2 a is exact.
    assert "mulsd" in ran.stdout and not re.search(r"vfn?m(add|sub)\d", ran.stdout)


def test_c99_sources_contain_only_code_the_compensator_needs():
    texts = generate_c99(gain_document("phase_lead"))
    assert "jaxhil_lead_filter_step" in texts["jaxhil_controller.c"]
    assert "identification" not in texts["jaxhil_controller.c"]
    assert "IDENTIFICATION" not in texts["jaxhil_controller.h"]
    includes = set(re.findall(r"#include <(.*)>", texts["jaxhil_controller.h"]))
    assert includes <= {"float.h", "math.h", "stdbool.h", "stddef.h", "stdint.h"}
    assert texts == generate_c99(gain_document("phase_lead"))


class ToyLaw(Compensator):
    """Compensator F_c = F + share (F - F_previous), with a non-ASCII character é in a comment."""

    gains: ClassVar = {"toy_share": GainSpecification("1")}

    def __init__(self, gains, period, clearance):
        self._share = gains["toy_share"]
        self._before = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured):
        # Only the share of the change /* of a tick */, which must not end the comment in C.
        command = force_measured + self._share * (force_measured - self._before)
        self._before = force_measured
        return command / (1.0 + velocity_desired)

    def reset(self):
        self._before = 0.0


class ToyLawWithText(ToyLaw):
    """Compensator outside the C99 subset."""

    def step(self, force_measured, position_desired, velocity_desired, position_measured):
        return force_measured + sum([position_desired, velocity_desired])


def toy_document(monkeypatch, law):
    """Return a gain document of the user-registered compensator `toy`."""
    monkeypatch.setitem(COMPENSATORS, "toy", law)
    gains = {"toy_share": {"value": 0.5, "unit": "1", "lower": 0.0, "upper": 1.0}}
    return sign(gain_document("none") | {"compensator": "toy", "gains": gains})


def test_c99_user_registered_compensator_equals_python_bit_for_bit(monkeypatch, tmp_path):
    document = toy_document(monkeypatch, ToyLaw)
    folder = c99_cases.write_sources(tmp_path, document)
    made = c99_cases.Batch(compiled(folder, "c99_driver.c", "driver.so", "-O2", "-shared", "-fPIC"), "toy")
    gain_file = check_gain_document(document)
    for kind in ("contact", "random", "hostile"):
        rows = c99_cases.drawn_rows(kind, 500, np.random.default_rng(0), c99_cases.PERIOD)
        rows[::7, 3] = -1.0  # a division by zero
        for guarded, python in ((True, c99_cases.controller_in_python), (False, c99_cases.law_in_python)):
            assert made.begin(c99_cases.packed("toy", gain_file))
            c99_cases.assert_same(made.run(rows, guarded), python(gain_file, rows), rows)


def test_c99_user_registered_compensator_outside_c99_subset_is_rejected(monkeypatch):
    line = inspect.getsourcelines(ToyLawWithText)[1] + 4
    expected = rf"^c99: toy: \S*test_c99_sources\.py:{line}: found sum\(\.\.\.\), expected [^\n]*$"
    with pytest.raises(InputError, match=expected):
        generate_c99(toy_document(monkeypatch, ToyLawWithText))


def test_c99_export_rejects_gain_document_that_runtime_rejects():
    document = gain_document()
    document["gains"]["forgetting"]["value"] = 0.99
    with pytest.raises(GainFileError, match="sha256"):
        generate_c99(document)
