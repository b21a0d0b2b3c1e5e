"""Archive of an FMU: a zip file with its description, its sources and, if compiled, its library for Linux."""

import hashlib
import io
import os
import shutil
import subprocess
import tempfile
import uuid
import zipfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from tuning.bundle.fmu.description import FmuDescription, build_description, model_description
from tuning.bundle.fmu.sources import common_files, files_to_compile, variable_files
from tuning.bundle.fmu.variables import Variable

LIBRARY_FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-ffp-contract=off", "-fvisibility=hidden")
LIBRARY_FOLDERS = {2: "binaries/linux64", 3: "binaries/x86_64-linux"}
DESCRIPTION_FILE = "modelDescription.xml"
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)  # the same for all files, so that equal FMUs are equal files


def build_fmu(
    identifier: str,
    name: str,
    description: str,
    period: float,
    variables: Sequence[Variable],
    files: Mapping[str, str],
    constants: Mapping[str, int | str],
    fmi: int,
    initial_inputs: Collection[str] = (),
) -> bytes:
    """Return the archive of an FMU with sources, without a library.

    Args:
        identifier: identifier of the model, which is also the name of the library.
        name: name that other tools display.
        description: description in one line.
        period: control period [s].
        variables: variables in the order of their value references.
        files: text of the model's source files by name.
        constants: constants of the model for its C code, by name.
        fmi: version of FMI, 2 or 3.
        initial_inputs: names of the inputs on which outputs depend before the first step.
    """
    sources = {**common_files(fmi), **files, **variable_files(variables, "", period, constants)}
    compiled = files_to_compile([*sources])
    described = FmuDescription(identifier, name, description, "", period, variables, compiled, initial_inputs)
    token = _token([model_description(described, fmi), *(text.encode() for text in sources.values())])
    sources |= variable_files(variables, token, period, constants)
    described = described._replace(token=token)
    contents = {DESCRIPTION_FILE: model_description(described, fmi)}
    if fmi == 3:
        contents["sources/buildDescription.xml"] = build_description(described)
    return _zip(contents | {f"sources/{name}": text.encode() for name, text in sorted(sources.items())})


def compile_library(archive: bytes) -> bytes | None:
    """Compile the library of an FMU; return None if there is no C compiler, or if the compilation fails."""
    compiler = find_compiler()
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory(prefix="jaxhil-fmu-") as temporary:
        folder = Path(temporary)
        sources = {Path(name).name: data for name, data in _unzip(archive).items() if "sources/" in name}
        for name, content in sources.items():
            (folder / name).write_bytes(content)
        command = [compiler, *LIBRARY_FLAGS, "-o", "library.so", *files_to_compile([*sources]), "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, check=False)
        return None if done.returncode else (folder / "library.so").read_bytes()


def find_compiler() -> str | None:
    """Return the path of a C compiler: `$CC`, cc, gcc or clang; None if there is none."""
    return shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc") or shutil.which("clang")


def add_library(archive: bytes, library: bytes | None) -> bytes:
    """Return the archive of an FMU with this library for Linux; without change if the library is None."""
    if library is None:
        return archive
    contents = _unzip(archive)
    return _zip({**contents, library_path(contents[DESCRIPTION_FILE]): library})


def find_library(archive: bytes) -> bytes | None:
    """Return the library for Linux in the archive of an FMU; None if it has none."""
    contents = _unzip(archive)
    return contents.get(library_path(contents[DESCRIPTION_FILE]))


def library_path(description: bytes) -> str:
    """Return the path of the library for Linux in the archive of an FMU with this modelDescription.xml."""
    root = ElementTree.fromstring(description)
    folder = LIBRARY_FOLDERS[int(root.attrib["fmiVersion"][0])]
    return f"{folder}/{root.find('CoSimulation').attrib['modelIdentifier']}.so"  # pyright: ignore


def _zip(contents: Mapping[str, bytes]) -> bytes:
    """Return a zip file whose bytes depend on nothing but its content."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        for name, content in contents.items():
            entry = zipfile.ZipInfo(name, _ZIP_DATE)
            entry.external_attr = 0o644 << 16
            file.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return archive.getvalue()


def _unzip(archive: bytes) -> dict[str, bytes]:
    """Return the content of each file in a zip file, by its path."""
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        return {name: file.read(name) for name in file.namelist()}


def _token(contents: Sequence[bytes]) -> str:
    """Return a text in the form of a GUID that identifies the content."""
    hashed = hashlib.sha256()
    for content in contents:
        hashed.update(hashlib.sha256(content).digest())
    return f"{{{uuid.UUID(bytes=hashed.digest()[:16])}}}"
