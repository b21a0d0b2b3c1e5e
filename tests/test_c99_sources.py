"""The C99 controller as sources: no warning, no memory of its own, no more exported than needed."""

import functools
import re
import shutil
import subprocess

import c99_cases
import pytest
from c99_cases import (
    compiled,
)
from gain_documents import gain_document, sign

from jaxhil.errors import InputError
from jaxhil.runtime import COMPENSATORS, GainFileError
from tuning.bundle import c99
from tuning.bundle.c99 import c99_texts

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
LAWS = tuple(COMPENSATORS)


@pytest.fixture(scope="module")
def controller_object(tmp_path_factory):
    """`controller_object(law)`: the folder with the law's sources and its controller.o."""

    @functools.cache
    def made(law):
        folder = c99_cases.write_sources(tmp_path_factory.mktemp(law), gain_document(law))
        strict = ("-Wconversion", "-Wshadow", "-Wstrict-prototypes", "-Wfloat-conversion")
        compiled(folder, "jaxhil_controller.c", "controller.o", "-c", "-O2", *strict)
        return folder

    return made


@pytest.mark.parametrize("law", LAWS)
def test_every_law_compiles_without_a_warning(law, controller_object):
    compiled(controller_object(law), "test_vectors.c", "test.o", "-c", "-O0")


@pytest.mark.parametrize("law", LAWS)
def test_controller_keeps_no_memory_of_its_own_and_calls_nothing_but_math(law, controller_object):
    if shutil.which("nm") is None:
        pytest.skip("no nm on this machine")
    folder = controller_object(law)
    listed = subprocess.run(["nm", "-P", "controller.o"], cwd=folder, capture_output=True, text=True).stdout
    symbols = [line.split()[:2] for line in listed.splitlines()]
    # memset, memcpy and memmove are what compilers make of loops and assignments, also for a free-standing
    # program.
    wanted = {name for name, kind in symbols if kind == "U"}
    assert wanted <= {
        "ceil",
        "floor",
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


def test_header_can_be_used_from_cpp(tmp_path):
    if shutil.which("c++") is None:
        pytest.skip("no C++ compiler (c++) on this machine")
    folder = c99_cases.write_sources(tmp_path, gain_document())
    (folder / "use.cpp").write_text('#include "jaxhil_controller.h"\njaxhil_controller controller;\n')
    command = ["c++", "-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-c", "use.cpp"]
    assert subprocess.run(command, cwd=folder).returncode == 0


def test_unsafe_arithmetic_is_refused_by_the_header(tmp_path):
    folder = c99_cases.write_sources(tmp_path, gain_document())
    command = [str(c99_cases.COMPILER), *c99.FLAGS, "-ffast-math", "-fsyntax-only", "jaxhil_controller.c"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert ran.returncode != 0 and "-ffast-math loses" in ran.stderr


def test_only_what_the_law_needs_is_exported():
    texts = c99_texts(gain_document("phase_lead"))
    assert "jaxhil_lead_filter_step" in texts["jaxhil_controller.c"]
    assert "identification" not in texts["jaxhil_controller.c"]
    assert "IDENTIFICATION" not in texts["jaxhil_controller.h"]
    includes = set(re.findall(r"#include <(.*)>", texts["jaxhil_controller.h"]))
    assert includes <= {"float.h", "math.h", "stdbool.h", "stddef.h", "stdint.h"}
    assert texts == c99_texts(gain_document("phase_lead"))


def test_law_without_a_c_file_is_named(monkeypatch):
    class Toy(COMPENSATORS["none"]):
        pass

    monkeypatch.setitem(COMPENSATORS, "toy", Toy)
    document = sign(gain_document("none") | {"compensator": "toy"})
    with pytest.raises(InputError, match=r"^jaxhil/c99/laws/toy\.c: found no such file"):
        c99_texts(document)


def test_document_that_the_runtime_refuses_is_refused():
    document = gain_document()
    document["gains"]["forgetting"]["value"] = 0.99
    with pytest.raises(GainFileError, match="sha256"):
        c99_texts(document)
