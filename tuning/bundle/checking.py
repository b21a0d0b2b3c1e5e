"""Check of a bundle on the workstation: manifest, signature, content, and self-test.

The code of a bundle is run only if every byte equals what this version of jaxhil exports for the same gains.
Then a copy of the checked bytes runs in a temporary folder.
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
from tuning.bundle.fmu.archive import find_library
from tuning.bundle.manifest import is_bundle, package_version

SELFTEST_TIMEOUT = 600.0  # longest duration of the self-test [s]
MAX_REASONS = 50  # largest number of reported reasons; a damaged file may have thousands
NOT_SIGNED = "not signed"
SIGNATURE_NOT_CHECKED = "present, but not checked: give the signer's public key with --key"
SIGNED_BY_KEY = "valid for the given key"
NOT_SIGNED_BY_KEY = "invalid: made with another key, or for another manifest"
PLOT = re.compile(rb'src="data:image/png;base64,([A-Za-z0-9+/=]*)"')

# Function that returns whether a signature belongs to a content (`tuning.bundle.signing.load_verifier`).
SignatureCheck = Callable[[bytes, bytes], bool]


class BundleCheck(NamedTuple):
    """Result of all checks of a bundle that do not run its code."""

    files: dict[str, bytes]  # content of each file by its path
    document: dict[str, Any]  # gain document; empty if the bundle is bad
    signature: str  # description of the signature's state
    reasons: list[str]  # why the bundle is bad; empty if it is good


def check_bundle(folder: Path, signed_by: SignatureCheck | None = None) -> BundleCheck:
    """Check the manifest, the signature and the content of a bundle.

    The content must equal what this version of jaxhil exports for the same gains and test vectors. The
    signature is checked only if the function `signed_by` is given.
    """
    checked = _check_manifest(folder, signed_by)
    if checked.reasons:
        return checked
    from jaxhil.simulation.gain_file import check_document

    try:
        document = json.loads(checked.files["gains.json"])
        check_document(document, "gains.json", any_axes=True)
    except (KeyError, ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, InputError) else "gains.json: is not a valid gain file"
        return checked._replace(reasons=[to_one_line(reason, 300)])
    reasons = _find_export_differences(
        checked.files, checked.files, lambda: _export_again(checked.files, document)
    )
    return checked._replace(document={} if reasons else document, reasons=reasons)


def find_code_differences(folder: Path, compensator: str, axes: int = 1) -> list[str]:
    """Compare the Python code in a bundle with the code that this version exports for the compensator.

    Return descriptions of the differences; the list is empty without differences. This does not import JAX.
    """
    checked = _check_manifest(folder, None)
    # Python's cache is not a reason, because the code is not run from this folder.
    reasons = [reason for reason in checked.reasons if selftest.PYTHON_CACHE not in reason]
    code = {name: content for name, content in checked.files.items() if name.endswith(".py")}
    return reasons or _find_export_differences(checked.files, code, lambda: code_files(compensator, axes))


def check_bundle_code(folder: Path, compensator: str, axes: int) -> None:
    """Raise `InputError` if the folder is a bundle with damage, or with code of another jaxhil version."""
    reasons = find_code_differences(folder, compensator, axes) if is_bundle(folder) else []
    if reasons:
        raise InputError(f"{to_one_line(str(folder))}: {reasons[0]}: for details, run jaxhil verify")


def run_selftest(checked: BundleCheck, name: str) -> tuple[list[str], list[str]]:
    """Run the self-test of a bundle that passed `check_bundle`; its output calls the folder `name`.

    Return the lines of output, and the reasons for a failure (empty if the self-test passed).
    """
    # The interpreter is isolated, so that no installed package except NumPy can replace a missing file.
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
            return [], [f"selftest.py: did not finish within {SELFTEST_TIMEOUT:g} s"]
    lines = [to_one_line(line) for line in (process.stdout + process.stderr).splitlines()]
    if not process.returncode:
        return lines, []
    failed = [line.removeprefix("FAIL").strip() for line in lines if line.startswith("FAIL ")]
    return lines, failed or [f"selftest.py: failed with exit code {process.returncode}"]


def _check_manifest(folder: Path, signed_by: SignatureCheck | None) -> BundleCheck:
    """Check the files of a bundle against its manifest and, with `signed_by`, the manifest's signature."""
    files, problems = selftest.find_differences(str(folder))
    reasons = [to_one_line(f"{name}: {text}", 300) for name, text in problems]
    signature, manifest = files.get(selftest.SIGNATURE_FILE), files.get(selftest.MANIFEST_FILE, b"")
    state = NOT_SIGNED if signature is None else SIGNATURE_NOT_CHECKED
    if signed_by is not None:
        state = SIGNED_BY_KEY
        if signature is None or not signed_by(signature, manifest):
            state = NOT_SIGNED if signature is None else NOT_SIGNED_BY_KEY
            signer = "no signature" if signature is None else "another signature"
            reasons.insert(
                0, f"{selftest.SIGNATURE_FILE}: found {signer}, expected the signature by the given key"
            )
    if len(reasons) > MAX_REASONS:
        reasons[MAX_REASONS:] = [f"and {len(reasons) - MAX_REASONS} more"]
    return BundleCheck(files, {}, state, reasons)


def _export_again(files: Mapping[str, bytes], document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files that this version of jaxhil exports for the bundle's gain document.

    The test vectors, the plot and the FMUs' libraries are taken from the bundle's `files`.
    """
    plot = PLOT.search(files["summary.html"])
    drawn = base64.b64decode(plot[1], validate=True) if plot else b""
    libraries = {name: find_library(content) for name, content in files.items() if name.endswith(".fmu")}
    return bundle_files(document, find_formats(files, document), files["vectors.csv"], drawn, libraries)


def _find_export_differences(
    files: Mapping[str, bytes], compared: Mapping[str, bytes], export: Callable[[], Mapping[str, bytes]]
) -> list[str]:
    """Compare files of a bundle with the files that `export` returns; describe the differences.

    `files` are all files of the bundle, `compared` are those to compare.
    """
    compared = {name: content for name, content in compared.items() if name != selftest.SIGNATURE_FILE}
    try:
        exported = dict(export())
    except Exception as error:  # a third-party gain file may cause any error
        reason = to_one_line(str(error), 200)
        return [f"gains.json: this version cannot export it: {reason}", _describe_origin(files)]
    expected = exported.pop(selftest.MANIFEST_FILE, None)
    reasons = []
    for name in sorted({*compared, *exported} - {selftest.MANIFEST_FILE}):
        if name not in exported:
            reasons.append(f"{name}: this version does not export such a file")
        elif name not in compared:
            reasons.append(f"{name}: is missing")
        elif exported[name] != compared[name]:
            reasons.append(f"{name}: differs from what this version exports")
    if not reasons and expected is not None and compared[selftest.MANIFEST_FILE] != expected:
        reasons.append(f"{selftest.MANIFEST_FILE}: differs from what this version exports for these files")
    return [*reasons, _describe_origin(files)] if reasons else []


def _describe_origin(files: Mapping[str, bytes]) -> str:
    """Return a message that the bundle's code was not run, with the version that the manifest names."""
    stated, present = json.loads(files[selftest.MANIFEST_FILE]).get("version"), package_version()
    if stated is None:
        return f"no code of the bundle was run: its manifest names no version, and this is {present}"
    if stated == present:
        return (
            f"no code of the bundle was run: its manifest names this version, {present}, which exports other "
            "files"
        )
    return (
        f"no code of the bundle was run: its manifest names {format_value(stated)}, and this is {present}: "
        "verify the bundle with the version that exported it"
    )
