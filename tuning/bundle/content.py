"""Content of all files in a bundle.

The gain document, the test vectors and the plot of the summary determine every byte. `jaxhil export` writes
this content, and `jaxhil verify` compares a bundle with it.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import jaxhil.rig
from jaxhil.errors import InputError
from tuning.bundle import selftest
from tuning.bundle.controller_kind import kind_of
from tuning.bundle.manifest import manifest_text

TUNING_FOLDER = Path(__file__).parents[1]
# Files that are copied unchanged into a bundle.
SELFTEST_FILES = ("bundle/selftest.py", "bundle/vector_replay.py")
UDP_FILES = ("rig/udp_controller.py", "rig/udp_protocol.py", "rig/udp_task.py")
FLIGHT_RECORDER = Path(jaxhil.rig.__file__).with_name("flight_recorder.py")


def code_files(compensator: str, axes: int = 1) -> dict[str, bytes]:
    """Return the Python files that every bundle of a compensator contains.

    These are the runtime, the flight recorder, the self-test, and the program that runs the controller as a
    process.

    Args:
        compensator: name of the compensator.
        axes: number of axes of motion.

    Returns:
        Content of each file by its path in the bundle.

    Raises:
        KeyError: If the runtime does not know the compensator.
        ValueError: If the runtime's modules cannot be joined into one file.
    """
    from tuning.bundle.single_file import build_runtime_source

    kind = kind_of({"axes": axes})
    names = (*SELFTEST_FILES, *UDP_FILES, kind.numerical_model)
    paths = [FLIGHT_RECORDER, *(TUNING_FOLDER / name for name in names)]
    copied = {path.name: path.read_bytes() for path in paths}
    runtime = build_runtime_source(compensator, kind.package, kind.table)
    return {"jaxhil_runtime.py": runtime.encode(), **copied}


def bundle_files(
    document: Mapping[str, Any],
    formats: Sequence[str],
    vectors: bytes,
    plot: bytes | None = None,
    libraries: Mapping[str, bytes | None] | None = None,
) -> dict[str, bytes]:
    """Return all files of a bundle for a checked gain document.

    Args:
        document: gain document.
        formats: names of the additional formats of the gains.
        vectors: content of the file vectors.csv.
        plot: plot for the summary, as PNG; None to draw a new plot.
        libraries: libraries of the FMUs by the FMU's path; None to compile them.

    Returns:
        Content of each file by its path in the bundle.

    Raises:
        InputError: If the compensator does not support a format.
        KeyError: If the runtime does not know the compensator.
        ValueError: If the runtime's modules cannot be joined into one file.
    """
    from tuning.bundle.fmu.archive import add_library, compile_library
    from tuning.bundle.readme import readme_text
    from tuning.bundle.summary import summary_html
    from tuning.bundle.writers import WRITERS

    gains = json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n"
    # Read the document back, so that all files have the key order of gains.json and not the caller's order.
    document = json.loads(gains)
    table = kind_of(document).limits
    if limits := document.get("limits"):
        document = {**document, "limits": {name: limits[name] for name in table if name in limits}}
    files = {
        "gains.json": gains.encode("ascii"),
        "vectors.csv": vectors,
        "summary.html": summary_html(document, plot),
        **code_files(document["compensator"], document.get("axes", 1)),
    }
    for name in formats:
        files.update(WRITERS[name](document))
    for name in [name for name in files if name.endswith(".fmu")]:
        library = compile_library(files[name]) if libraries is None else libraries.get(name)
        files[name] = add_library(files[name], library)
    files["README.md"] = readme_text(document, files).encode()
    files[selftest.MANIFEST_FILE] = manifest_text(files, document)
    return files


def find_formats(names: Collection[str], document: Mapping[str, Any]) -> list[str]:
    """Return the names of the additional formats that a bundle contains, from the names of its files."""
    from tuning.bundle.writers import ON_REQUEST, WRITERS

    formats = []
    for name, write in WRITERS.items():
        # To generate an FMU takes seconds.
        if name in ON_REQUEST and not any(path.startswith(ON_REQUEST[name]) for path in names):
            continue
        try:
            content = write(document)
        except InputError:
            continue  # the compensator does not support the format
        if {*content} & {*names}:
            formats.append(name)
    return formats
