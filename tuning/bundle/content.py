"""Content of the files of a bundle, as this version writes them.

Given the vectors and the plot of the summary, the gain document determines every byte of a bundle.
`export` writes this content, and `verify` compares a bundle with it.
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
    """Return the Python code of every bundle of a compensator, by path.

    These are the runtime, the self-test and the UDP controller.

    Args:
        compensator: name of the compensator.

    Returns:
        Content of each file by its path in the bundle.

    Raises:
        KeyError: If the runtime does not know the compensator.
        ValueError: If the runtime's modules cannot be joined to one file.
    """
    from tuning.bundle.single_file import build_runtime_source

    copied = {Path(name).name: (TUNING_FOLDER / name).read_bytes() for name in COPIED_FILES}
    return {"jaxhil_runtime.py": build_runtime_source(compensator).encode(), **copied}


def bundle_files(
    document: Mapping[str, Any], formats: Sequence[str], vectors: bytes, plot: bytes | None = None
) -> dict[str, bytes]:
    """Return all files of the bundle of a checked gain document, by path.

    Args:
        document: the gain document.
        formats: names of the additional formats of the gains.
        vectors: content of vectors.csv.
        plot: plot of the summary (PNG); None draws it.

    Returns:
        Content of each file by its path in the bundle.

    Raises:
        InputError: If the compensator does not support a format.
        KeyError, ValueError: As `code_files`.
    """
    from tuning.bundle.readme import readme_text
    from tuning.bundle.summary import summary_html
    from tuning.bundle.writers import WRITERS

    gains = json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n"
    # The file sorts its keys, so the content must not depend on the caller's order.
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
    """Return the formats of which a bundle with these file names contains files."""
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
