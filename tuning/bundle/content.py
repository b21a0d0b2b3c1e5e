"""The files of a bundle, as this version makes them.

Given its vectors and the picture of its summary, a bundle follows from its gain document to the byte: so
`export` writes it, and so `verify` knows whether a bundle is what this version exports.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from jaxhil.rig.limits import LIMITS
from tuning.bundle import selftest
from tuning.bundle.manifest import manifest_text

TUNING = Path(__file__).parents[1]
# Files that a bundle holds as they are here.
COPIED = ("bundle/selftest.py", "rig/udp_controller.py", "rig/udp_protocol.py")


def code_files(compensator: str) -> dict[str, bytes]:
    """What runs as it is in every bundle of a compensator, by path: the runtime, self-test, UDP controller.

    Raises KeyError for a compensator that the runtime does not know, ValueError for one that cannot be put
    into one file.
    """
    from tuning.bundle.single_file import runtime_source

    copied = {Path(name).name: (TUNING / name).read_bytes() for name in COPIED}
    return {"jaxhil_runtime.py": runtime_source(compensator).encode(), **copied}


def bundle_files(
    document: Mapping[str, Any], formats: Sequence[str], vectors: bytes, picture: bytes | None = None
) -> dict[str, bytes]:
    """All files of the bundle of a checked gain document, by path; without a `picture` (PNG) of the summary,
    it is drawn.

    Raises as `code_files`, and InputError for a format that the compensator lacks.
    """
    from tuning.bundle.readme import readme_text
    from tuning.bundle.summary import summary_html
    from tuning.bundle.writers import WRITERS

    gains = json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n"
    # In what order a caller put keys is not known from the file.
    document = json.loads(gains)
    if limits := document.get("limits"):
        document = {**document, "limits": {name: limits[name] for name in LIMITS if name in limits}}
    files = {
        "gains.json": gains.encode("ascii"),
        "vectors.csv": vectors,
        "summary.html": summary_html(document, picture),
        **code_files(document["compensator"]),
    }
    for name in formats:
        files.update(WRITERS[name](document))
    files["README.md"] = readme_text(document, files).encode()
    files[selftest.MANIFEST] = manifest_text(files, document)
    return files


def formats_among(names: Collection[str], document: Mapping[str, Any]) -> list[str]:
    """The formats of which a bundle that holds files of these names has any."""
    from tuning.bundle.writers import WRITERS

    found = []
    for name, write in WRITERS.items():
        try:
            made = write(document)
        except InputError:
            continue  # the compensator lacks it
        if {*made} & {*names}:
            found.append(name)
    return found
