"""Check of a bundle on the workstation: manifest, signature, content, and self-test.

No code of a bundle is run unless it equals, byte for byte, what this version exports for these gains. The
code that is run is a copy of the checked bytes in a temporary folder.
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

from jaxhil.errors import InputError, format_value, to_one_line
from tuning.bundle import selftest
from tuning.bundle.content import bundle_files, code_files, find_formats
from tuning.bundle.manifest import package_version

SELFTEST_TIMEOUT = 600.0  # s; time limit of the self-test
MAX_REASONS = 50
NOT_SIGNED = "not signed"
SIGNATURE_NOT_CHECKED = "there is one; only verification with the public key (--key) proves whose"
SIGNED_BY_KEY = "by the key given"
NOT_SIGNED_BY_KEY = "not by the key given, or not of this manifest"
PLOT = re.compile(rb'src="data:image/png;base64,([A-Za-z0-9+/=]*)"')

# Function that checks the signature of bytes, as `tuning.bundle.signing.verifier` returns it.
SignatureCheck = Callable[[bytes, bytes], bool]


class BundleCheck(NamedTuple):
    """Result of the checks of a bundle without running its code."""

    files: dict[str, bytes]  # content of each file by its path
    document: dict[str, Any]  # gain document; empty if the bundle is bad
    signature: str  # state of the signature, in words
    reasons: list[str]  # reasons for a bad bundle; empty for a good one


def check_bundle(folder: Path, signed_by: SignatureCheck | None = None) -> BundleCheck:
    """Check that a bundle is intact, signed, and what this version exports for its gains and vectors.

    The signature is checked only if `signed_by` is given.
    """
    checked = _check_manifest(folder, signed_by)
    if checked.reasons:
        return checked
    from jaxhil.simulation.gain_file import check_document

    try:
        document = json.loads(checked.files["gains.json"])
        check_document(document, "gains.json")
    except (KeyError, ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, InputError) else "gains.json: not a gain file"
        return checked._replace(reasons=[to_one_line(reason, 300)])
    reasons = _find_export_differences(
        checked.files, checked.files, lambda: _export_again(checked.files, document)
    )
    return checked._replace(document={} if reasons else document, reasons=reasons)


def find_code_differences(folder: Path, compensator: str) -> list[str]:
    """Return why a bundle's Python code differs from this version's for a compensator; empty if it does not.

    This does not import jax.
    """
    checked = _check_manifest(folder, None)
    # Python's cache beside the sources is not used here.
    reasons = [reason for reason in checked.reasons if selftest.PYTHON_CACHE not in reason]
    code = {name: content for name, content in checked.files.items() if name.endswith(".py")}
    return reasons or _find_export_differences(checked.files, code, lambda: code_files(compensator))


def run_selftest(checked: BundleCheck, name: str) -> tuple[list[str], list[str]]:
    """Run the self-test of a good bundle called `name`; return its output and the reasons for a failure."""
    # The interpreter is isolated, so that no installed package but NumPy replaces a missing file.
    needs_numpy = re.search(rb"^(?:import|from) numpy\b", checked.files["jaxhil_runtime.py"], re.MULTILINE)
    isolated = ["-I", "-B"] if needs_numpy else ["-I", "-S", "-B"]
    with tempfile.TemporaryDirectory(prefix="jaxhil-verify-") as temporary:
        folder = Path(temporary) / (name or "bundle")
        for path, content in checked.files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
        command = [sys.executable, *isolated, str(folder / "selftest.py")]
        try:
            process = subprocess.run(
                command,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=SELFTEST_TIMEOUT,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return [], [f"selftest.py: found no end within {SELFTEST_TIMEOUT:g} s"]
    lines = [to_one_line(line) for line in (process.stdout + process.stderr).splitlines()]
    if not process.returncode:
        return lines, []
    failed = [line.removeprefix("FAIL").strip() for line in lines if line.startswith("FAIL ")]
    return lines, failed or [f"selftest.py: ended with exit code {process.returncode}"]


def _check_manifest(folder: Path, signed_by: SignatureCheck | None) -> BundleCheck:
    """Check a bundle against its manifest and, with a key, the manifest against its signature."""
    files, problems = selftest.find_differences(str(folder))
    reasons = [to_one_line(f"{name}: {text}", 300) for name, text in problems]
    signature, manifest = files.get(selftest.SIGNATURE_FILE), files.get(selftest.MANIFEST_FILE, b"")
    state = NOT_SIGNED if signature is None else SIGNATURE_NOT_CHECKED
    if signed_by is not None:
        state = SIGNED_BY_KEY
        if signature is None or not signed_by(signature, manifest):
            state = NOT_SIGNED if signature is None else NOT_SIGNED_BY_KEY
            signer = "none" if signature is None else "another"
            reasons.insert(
                0, f"{selftest.SIGNATURE_FILE}: found {signer}, expected the manifest's by the key given"
            )
    if len(reasons) > MAX_REASONS:
        reasons[MAX_REASONS:] = [f"and {len(reasons) - MAX_REASONS} more"]
    return BundleCheck(files, {}, state, reasons)


def _export_again(files: Mapping[str, bytes], document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files that this version exports for the document, with the given vectors and plot."""
    plot = PLOT.search(files["summary.html"])
    drawn = base64.b64decode(plot[1], validate=True) if plot else b""
    return bundle_files(document, find_formats(files, document), files["vectors.csv"], drawn)


def _find_export_differences(
    files: Mapping[str, bytes], compared: Mapping[str, bytes], make: Callable[[], Mapping[str, bytes]]
) -> list[str]:
    """Return in words which of the `compared` files differ from the result of `make`."""
    compared = {name: content for name, content in compared.items() if name != selftest.SIGNATURE_FILE}
    try:
        exported = dict(make())
    except Exception as error:  # a third-party gain file may cause any error
        reason = to_one_line(str(error), 200)
        return [f"gains.json: this version cannot export it: {reason}", _describe_origin(files)]
    expected = exported.pop(selftest.MANIFEST_FILE, None)
    reasons = []
    for name in sorted({*compared, *exported} - {selftest.MANIFEST_FILE}):
        if name not in exported:
            reasons.append(f"{name}: is no file that this version exports")
        elif name not in compared:
            reasons.append(f"{name}: is not here")
        elif exported[name] != compared[name]:
            reasons.append(f"{name}: is not what this version exports")
    if not reasons and expected is not None and compared[selftest.MANIFEST_FILE] != expected:
        reasons.append(f"{selftest.MANIFEST_FILE}: is not what this version writes of these files")
    return [*reasons, _describe_origin(files)] if reasons else []


def _describe_origin(files: Mapping[str, bytes]) -> str:
    """Return a text on the version that wrote a bundle, and on what to do."""
    stated, present = json.loads(files[selftest.MANIFEST_FILE]).get("version"), package_version()
    if stated is None:
        return f"nothing of it was run: it does not say which version wrote it, and this is {present}"
    if stated == present:
        return f"nothing of it was run: it says that this version, {present}, wrote it, which did not"
    return (
        f"nothing of it was run: it says that {format_value(stated)} wrote it, and this is {present}: "
        f"verify it with that version"
    )
