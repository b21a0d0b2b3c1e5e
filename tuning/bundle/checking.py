"""A bundle checked from the workstation: its manifest, its signature, whether it is what this version
exports, and then its own self-test.

Nothing that a bundle holds is run unless it is, byte for byte, what this version exports for these gains; and
what is run are the bytes that were checked, in a folder of their own.
"""

import base64
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxhil.errors import InputError, one_line, shown
from tuning.bundle import selftest
from tuning.bundle.content import bundle_files, code_files, formats_among
from tuning.bundle.manifest import version

LONGEST = 600.0  # s
MOST_REASONS = 50
NOT_SIGNED = "not signed"
NOT_CHECKED = "there is one; only verification with the public key (--key) proves whose"
PROVED = "by the key given"
OTHER = "not by the key given, or not of this manifest"
PICTURE = re.compile(rb'src="data:image/png;base64,([A-Za-z0-9+/=]*)"')

# Whether a signature is that of the bytes, as `tuning.bundle.signing.verifier` makes it.
Verifier = Callable[[bytes, bytes], bool]


class Checked(NamedTuple):
    """What is known of a bundle of which nothing was run."""

    files: dict[str, bytes]  # the content of each by its path
    document: dict[str, Any]  # of its gain file; empty if it is bad
    signature: str  # what is known of it, in words
    reasons: list[str]  # why it is bad; none if it is good


def check_bundle(folder: Path, signed_by: Verifier | None = None) -> Checked:
    """The bundle is intact, signed by that key if one is given, and all of it is what this version exports
    for its gains, given the vectors."""
    checked = _intact(folder, signed_by)
    if checked.reasons:
        return checked
    from jaxhil.simulation.gain_file import check_document

    try:
        document = json.loads(checked.files["gains.json"])
        check_document(document, "gains.json")
    except (KeyError, ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, InputError) else "gains.json: not a gain file"
        return checked._replace(reasons=[one_line(reason, 300)])
    reasons = _foreign(checked.files, checked.files, lambda: _exported(checked.files, document))
    return checked._replace(document={} if reasons else document, reasons=reasons)


def check_code(folder: Path, compensator: str) -> list[str]:
    """Why the Python code of a bundle is not what this version exports for a compensator; empty if it is.

    Imports no jax.
    """
    checked = _intact(folder, None)
    # What Python keeps beside the sources is not run from here.
    reasons = [reason for reason in checked.reasons if selftest.CACHE not in reason]
    code = {name: content for name, content in checked.files.items() if name.endswith(".py")}
    return reasons or _foreign(checked.files, code, lambda: code_files(compensator))


def run_selftest(checked: Checked, name: str) -> tuple[list[str], list[str]]:
    """What the self-test of a good bundle, called `name`, prints, and why it fails; nothing if it passes."""
    # Isolated: nothing that is installed may stand in for what is not there, but NumPy where it is needed.
    needs_numpy = re.search(rb"^(?:import|from) numpy\b", checked.files["jaxhil_runtime.py"], re.MULTILINE)
    isolated = ["-I", "-B"] if needs_numpy else ["-I", "-S", "-B"]
    with tempfile.TemporaryDirectory(prefix="jaxhil-verify-") as place:
        folder = Path(place) / (name or "bundle")
        for path, content in checked.files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
        command = [sys.executable, *isolated, str(folder / "selftest.py")]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, errors="replace", timeout=LONGEST, check=False
            )
        except subprocess.TimeoutExpired:
            return [], [f"selftest.py: found no end within {LONGEST:g} s"]
    lines = [one_line(line) for line in (done.stdout + done.stderr).splitlines()]
    if not done.returncode:
        return lines, []
    failed = [line.removeprefix("FAIL").strip() for line in lines if line.startswith("FAIL ")]
    return lines, failed or [f"selftest.py: ended with exit code {done.returncode}"]


def _intact(folder: Path, signed_by: Verifier | None) -> Checked:
    """The bundle against its manifest and, with a key, the manifest against its signature."""
    found, problems = selftest.differences(str(folder))
    reasons = [one_line(f"{name}: {text}", 300) for name, text in problems]
    signature, manifest = found.get(selftest.SIGNATURE), found.get(selftest.MANIFEST, b"")
    known = NOT_SIGNED if signature is None else NOT_CHECKED
    if signed_by is not None:
        known = PROVED
        if signature is None or not signed_by(signature, manifest):
            known = NOT_SIGNED if signature is None else OTHER
            given = "none" if signature is None else "another"
            reasons.insert(0, f"{selftest.SIGNATURE}: found {given}, allowed the manifest's by the key given")
    if len(reasons) > MOST_REASONS:
        reasons[MOST_REASONS:] = [f"and {len(reasons) - MOST_REASONS} more"]
    return Checked(found, {}, known, reasons)


def _exported(files: Mapping[str, bytes], document: Mapping[str, Any]) -> dict[str, bytes]:
    """The bundle of the document with the vectors and the picture of these files."""
    picture = PICTURE.search(files["summary.html"])
    drawn = base64.b64decode(picture[1], validate=True) if picture else b""
    return bundle_files(document, formats_among(files, document), files["vectors.csv"], drawn)


def _foreign(
    files: Mapping[str, bytes], compared: Mapping[str, bytes], make: Callable[[], Mapping[str, bytes]]
) -> list[str]:
    """Of the bundle's `files` those `compared` that are not what `make` makes, in words."""
    compared = {name: content for name, content in compared.items() if name != selftest.SIGNATURE}
    try:
        made = dict(make())
    except Exception as error:  # a gain file from elsewhere leads anywhere
        reason = one_line(str(error), 200)
        return [f"gains.json: this version cannot export it: {reason}", _origin(files)]
    expected = made.pop(selftest.MANIFEST, None)
    reasons = []
    for name in sorted({*compared, *made} - {selftest.MANIFEST}):
        if name not in made:
            reasons.append(f"{name}: is no file that this version exports")
        elif name not in compared:
            reasons.append(f"{name}: is not here")
        elif made[name] != compared[name]:
            reasons.append(f"{name}: is not what this version exports")
    if not reasons and expected is not None and compared[selftest.MANIFEST] != expected:
        reasons.append(f"{selftest.MANIFEST}: is not what this version writes of these files")
    return [*reasons, _origin(files)] if reasons else []


def _origin(files: Mapping[str, bytes]) -> str:
    """Which version a bundle says it is from, and what to do."""
    stated, own = json.loads(files[selftest.MANIFEST]).get("version"), version()
    if stated is None:
        return f"nothing of it was run: it does not say which version wrote it, and this is {own}"
    if stated == own:
        return f"nothing of it was run: it says that this version, {own}, wrote it, which did not"
    return (
        f"nothing of it was run: it says that {shown(stated)} wrote it, and this is {own}: "
        f"verify it with that version"
    )
