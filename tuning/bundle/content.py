"""Content of all files in a bundle.

The gain document, the test vectors and the plot of the summary determine every byte. `jaxhil export` writes
this content, and `jaxhil verify` compares a bundle with it.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from jaxhil.rig.limits import LIMITS
from tuning.bundle import selftest
from tuning.bundle.manifest import manifest_text

TUNING_FOLDER = Path(__file__).parents[1]
# Files that are copied unchanged into a bundle.
COPIED_FILES = ("bundle/selftest.py", "rig/udp_controller.py", "rig/udp_protocol.py")


def code_files(compensator: str) -> dict[str, bytes]:
    """Return the Python files that every bundle of a compensator contains.

    These are the runtime, the self-test and the UDP controller.

    Args:
        compensator: name of the compensator.

    Returns:
        Content of each file by its path in the bundle.

    Raises:
        KeyError: If the runtime does not know the compensator.
        ValueError: If the runtime's modules cannot be joined into one file.
    """
    from tuning.bundle.single_file import build_runtime_source

    copied = {Path(name).name: (TUNING_FOLDER / name).read_bytes() for name in COPIED_FILES}
    return {"jaxhil_runtime.py": build_runtime_source(compensator).encode(), **copied}


def bundle_files(
    document: Mapping[str, Any], formats: Sequence[str], vectors: bytes, plot: bytes | None = None
) -> dict[str, bytes]:
    """Return all files of a bundle for a checked gain document.

    Args:
        document: gain document.
        formats: names of the additional formats of the gains.
        vectors: content of the file vectors.csv.
        plot: plot for the summary, as PNG; None to draw a new plot.

    Returns:
        Content of each file by its path in the bundle.

    Raises:
        InputError: If the compensator does not support a format.
        KeyError: If the runtime does not know the compensator.
        ValueError: If the runtime's modules cannot be joined into one file.
    """
    from tuning.bundle.readme import readme_text
    from tuning.bundle.summary import summary_html
    from tuning.bundle.writers import WRITERS

    gains = json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n"
    # Read the document back, so that all files have the key order of gains.json and not the caller's order.
    document = json.loads(gains)
    if limits := document.get("limits"):
        document = {**document, "limits": {name: limits[name] for name in LIMITS if name in limits}}
    files = {
        "gains.json": gains.encode("ascii"),
        "vectors.csv": vectors,
        "summary.html": summary_html(document, plot),
        **code_files(document["compensator"]),
    }
    for name in formats:
        files.update(WRITERS[name](document))
    files["README.md"] = readme_text(document, files).encode()
    files[selftest.MANIFEST_FILE] = manifest_text(files, document)
    return files


def find_formats(names: Collection[str], document: Mapping[str, Any]) -> list[str]:
    """Return the names of the additional formats that a bundle contains, from the names of its files."""
    from tuning.bundle.writers import WRITERS

    formats = []
    for name, write in WRITERS.items():
        try:
            content = write(document)
        except InputError:
            continue  # the compensator does not support the format
        if {*content} & {*names}:
            formats.append(name)
    return formats
