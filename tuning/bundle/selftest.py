"""Self-test of a bundle: program that checks the files and replays recorded ticks through the controller.

    python selftest.py          check the files and the gains, and replay all test vectors in Python
    python selftest.py --c      also compile the controller in C and its FMUs (with cc or $CC), and replay
                                them in C

The program needs only Python 3.11 or later. It prints one line per check. The exit code is 0 if all checks
pass, else 1. The program cannot show who exported the bundle: use `jaxhil verify --key` on a workstation.
"""

import hashlib
import io
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import zipfile
import zlib

MANIFEST_FILE, SIGNATURE_FILE, PYTHON_CACHE = "manifest.json", "manifest.sig", "__pycache__/"
# Pattern of a file's path in the manifest.
PATH_PATTERN = re.compile(r"(?:\w[\w.-]{0,99}/){0,3}\w[\w.-]{0,99}", re.ASCII)
# Limits of a bundle: files and bytes; and bytes of a text file in it.
MAX_FILES, MAX_BUNDLE_BYTES, MAX_TEXT_BYTES = 1000, 1 << 26, 1 << 23
SCHEMA = "jaxhil/bundle/1"
MAX_REPORTED_DIFFERENCES = 8  # largest number of reported differences in one file
RUNTIME_FILE, REPLAY_FILE = "jaxhil_runtime.py", "vector_replay.py"
# Folders with the controller in C, and the FMU in each; the sources of an FMU are in its archive.
C_FOLDERS = {"c99": None, "fmi3": "fmi3/jaxhil_controller.fmu", "fmi2": "fmi2/jaxhil_controller.fmu"}
C_FILES = ("test_vectors.c", "jaxhil_controller.c")  # files to compile in the folder c99
C_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")


def main(arguments, folder):
    """Run all checks on the bundle in `folder`; return True if all checks pass."""
    print(
        f"self-test of {escape_unprintable(os.path.basename(os.path.abspath(folder)))}, Python "
        f"{sys.version.split()[0]}"
    )
    found, damaged = check_files(folder)
    replay = load_module(folder, REPLAY_FILE, found, damaged, ("replay_vectors",))
    runtime = load_module(folder, RUNTIME_FILE, found, damaged, ("GainFileError",))
    runs = None not in (replay, runtime) and "gains.json" in found
    agrees = runs and check_gains(folder, replay, runtime) and check_vectors(folder, found, replay, runtime)
    agrees_in_c = "--c" not in arguments or check_c(found, damaged)
    good = not damaged and agrees is agrees_in_c is True
    print("PASSED" if good else "FAILED: do not use this bundle on a rig")
    return good


def check_files(folder):
    """Check every file against the manifest; return the files' contents, and the names of differing files."""
    found, problems = find_differences(folder)
    reported = {}
    for name, text in problems:
        if name.endswith(PYTHON_CACHE):
            print(f"note  {escape_unprintable(name)}: {text}")  # running the controller creates the cache
            continue
        reported[name] = reported.get(name, 0) + 1
        if reported[name] <= MAX_REPORTED_DIFFERENCES:
            report_failure(name, text)
    for name, number in reported.items():
        if number > MAX_REPORTED_DIFFERENCES:
            report_failure(name, f"and {number - MAX_REPORTED_DIFFERENCES} more")
    if not reported:
        report_pass(
            MANIFEST_FILE,
            f"{len({*found} - {MANIFEST_FILE, SIGNATURE_FILE})} files are as they were exported",
        )
        signed = "is signed; only `jaxhil verify --key` proves by whom"
        print(f"note  {MANIFEST_FILE}: {signed if SIGNATURE_FILE in found else 'is not signed'}")
    return found, {*reported}


def find_differences(folder):
    """Compare all files in a bundle's folder with its manifest.

    Return the content of each file by its path, and a list with (path, description) for each difference.
    """
    found, problems, wrong, left = {}, [], [], MAX_BUNDLE_BYTES
    if os.path.lexists(os.path.join(folder, SIGNATURE_FILE)):
        problems += try_read_file(found, folder, SIGNATURE_FILE, 64)  # bytes of an Ed25519 signature
    try:
        found[MANIFEST_FILE] = read_plain_file(folder, MANIFEST_FILE, MAX_TEXT_BYTES)
        wrong = [(MANIFEST_FILE, text) for text in find_manifest_differences(found[MANIFEST_FILE])]
        files, values = read_manifest_entries(found[MANIFEST_FILE])
    except Exception as error:
        return found, [*problems, *wrong, (MANIFEST_FILE, f"cannot be read: {describe_error(error)}")]
    if wrong:
        return found, problems + wrong  # a damaged manifest cannot be compared with other files
    for name, entry in files.items():
        problems += try_read_file(found, folder, name, left)
        content = found.get(name, b"")
        left -= len(content)
        same = len(content) == entry["bytes"] and hashlib.sha256(content).hexdigest() == entry["sha256"]
        if name in found and not same:
            problems += [(name, text) for text in find_differing_lines(content, entry.get("lines"))]
            if name == "gains.json":
                problems += [(name, text) for text in find_value_differences(content, values)]
    for name in find_unlisted_paths(folder, files):
        compiled = "contains compiled code, which is not checked: delete this folder before use"
        problems.append((name, compiled if name.endswith(PYTHON_CACHE) else "is not a file of this bundle"))
    return found, problems


def read_manifest_entries(manifest):
    """Read from the manifest the entry of each file, and the values in the gain file.

    Raise an error if the manifest is invalid.
    """
    document = json.loads(manifest)
    if document["schema"] != SCHEMA:
        raise ValueError(f"schema: found {format_value(document['schema'])}, expected '{SCHEMA}'")
    files, values = document["files"], document["values"]
    for name, entry in files.items():
        if not PATH_PATTERN.fullmatch(name) or name in (MANIFEST_FILE, SIGNATURE_FILE):
            raise ValueError(f"'{format_value(name)}' is not a valid path in a bundle")
        if (type(entry["sha256"]), type(entry["bytes"]), type(entry.get("lines", ""))) != (str, int, str):
            raise ValueError(f"'{format_value(name)}': the entry has values of a wrong type")
    if len(files) > MAX_FILES or sum(entry["bytes"] for entry in files.values()) > MAX_BUNDLE_BYTES:
        raise ValueError(f"the manifest lists more than {MAX_FILES} files or {MAX_BUNDLE_BYTES} bytes")
    return files, dict(values)


def find_manifest_differences(content):
    """Check a manifest against the checksums at its end; return descriptions of the differences."""
    body, found, seal = content.rpartition(b',\n "own_lines": ')
    try:
        seals = json.loads(b'{"own_lines": ' + seal) if found else {}
        if hashlib.sha256(body).hexdigest() == seals["own_sha256"]:
            # The checksums must also have the exported notation.
            good = seal == build_manifest_seal(body).partition(b',\n "own_lines": ')[2]
            line = body.count(b"\n") + 2
            return [] if good else [f"line {line} or later: differs from what was exported"]
        return find_differing_lines(body, seals["own_lines"])
    except Exception:
        return ["the checksums at its end differ from what was exported"]


def build_manifest_seal(body):
    """Return the end of a manifest: the checksum of each line of its body, and the SHA-256 of the body."""
    checks = json.dumps(line_checksums(body))
    return f',\n "own_lines": {checks},\n "own_sha256": "{hashlib.sha256(body).hexdigest()}"\n}}\n'.encode()


def line_checksums(content):
    """Return the CRC-32 of every line as eight hexadecimal digits, without the line endings."""
    lines = content.replace(b"\r\n", b"\n").split(b"\n")
    return " ".join(f"{zlib.crc32(line):08x}" for line in lines)


def find_differing_lines(content, checksums):
    """Describe which lines of a file differ from their checksums; `checksums` is None for a binary file."""
    if checksums is None or len(content) > MAX_TEXT_BYTES:
        return [f"differs from what was exported (found {len(content)} bytes)"]
    found, expected = line_checksums(content).split(), checksums.split()
    if found == expected:
        return ["its line endings differ from what was exported"]
    if len(found) == len(expected):
        pairs = enumerate(zip(found, expected, strict=True), start=1)
        return [f"line {number}: differs from what was exported" for number, (a, b) in pairs if a != b]
    first = [*(a == b for a, b in zip(found, expected, strict=False)), False].index(False)
    return [f"line {first + 1}: differs from what was exported; {len(found)} lines, expected {len(expected)}"]


def find_value_differences(content, expected):
    """Yield a text for each changed value of the gain file: key, found value and expected value."""
    try:
        found = dict(flatten_document(json.loads(content), ""))
    except Exception:
        return
    for key in sorted({*expected, *found}):
        texts = [format_value(values.get(key, "nothing")) for values in (found, expected)]
        if found.get(key) != expected.get(key):
            yield f"{escape_unprintable(key)}: found {texts[0]}, expected {texts[1]}"


def flatten_document(value, key):
    """Yield (key, value) of all values in nested JSON data, with dotted keys and values as JSON text."""
    if isinstance(value, (dict, list)) and value:
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from flatten_document(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, json.dumps(value)


def find_unlisted_paths(folder, files, within=""):
    """Yield the paths of files and folders that the manifest does not list; folders end with a slash."""
    for entry in sorted(os.scandir(os.path.join(folder, within)), key=lambda item: item.name):
        path, is_folder = within + entry.name, entry.is_dir(follow_symlinks=False)
        if is_folder and any(name.startswith(f"{path}/") for name in files):
            yield from find_unlisted_paths(folder, files, f"{path}/")
        elif is_folder or path not in {*files, MANIFEST_FILE, SIGNATURE_FILE}:
            yield f"{path}/" if is_folder else path


def load_module(folder, name, found, damaged, expected):
    """Execute a checked source file; return its namespace, or None after an error.

    `expected` are names that the namespace must contain.
    """
    if {name, MANIFEST_FILE} & damaged:
        return report_failure(
            name, "is not executed, because this file or the manifest differs from what was exported"
        )
    namespace = {"__name__": name.removesuffix(".py"), "__file__": os.path.join(folder, name)}
    try:
        # An import statement could load a cached older version, and does not find this folder with -I.
        exec(compile(found[name], name, "exec"), namespace)
        if missing := [text for text in expected if text not in namespace]:
            raise NameError(f"{', '.join(missing)} is missing")
    except BaseException as error:
        return report_failure(name, f"cannot be executed: {describe_error(error)}")
    return namespace


def check_gains(folder, replay, runtime):
    """Check that the controller accepts the gain file."""
    try:
        controller = runtime[replay["controller_name"](runtime)].from_file(os.path.join(folder, "gains.json"))
    except runtime["GainFileError"] as error:
        return report_failure("gains.json", escape_unprintable(str(error)))
    except BaseException as error:
        return report_failure("gains.json", f"cannot be loaded: {describe_error(error)}")
    period = controller.control_period
    laws = runtime.get("COMPENSATORS") or runtime.get("SIX_AXIS_COMPENSATORS", ())
    return report_pass("gains.json", f"loads: {' '.join(laws)}, control period {period!r} s")


def check_vectors(folder, found, replay, runtime):
    """Replay the test vectors through the runtime, and compare its commands.

    Every command must equal the recorded command to the last bit, and be close to the simulated command.
    """
    try:
        layout = replay["LAYOUTS"][replay["controller_name"](runtime)]
        rows = list(replay["read_vectors"](found["vectors.csv"].decode("ascii"), layout))
    except Exception as error:
        return report_failure("vectors.csv", f"cannot be read: {describe_error(error)}")
    if not rows:
        return report_failure("vectors.csv", "contains no ticks")
    try:
        runs, different = replay["replay_vectors"](rows, os.path.join(folder, "gains.json"), runtime)
    except BaseException as error:
        return report_failure("vectors.csv", f"cannot be replayed: {describe_error(error)}")
    for text in different[:MAX_REPORTED_DIFFERENCES]:
        report_failure("vectors.csv", text)
    if different:
        return report_failure("vectors.csv", f"{len(different)} of {len(rows)} ticks differ")
    report_pass("vectors.csv", f"{len(rows)} ticks of {len(runs)} runs, the same bit for bit")
    agrees, text = replay["compare_simulated"](runs, layout)
    return (report_pass if agrees else report_failure)("vectors.csv", text)


def check_c(found, damaged):
    """Compile the controller in each folder with C code; check that it reproduces the test vectors."""
    folders = [name for name in C_FOLDERS if any(path.startswith(f"{name}/") for path in {*found, *damaged})]
    compiler = shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc") or shutil.which("clang")
    good = bool(folders) or report_failure("c99", "found no file in C, expected a bundle with c99 or FMUs")
    for name in folders:
        if MANIFEST_FILE in damaged or any(path.startswith(f"{name}/") for path in damaged):
            good = report_failure(name, "is not compiled, because a file is missing or differs")
        elif compiler is None:
            good = report_failure(name, "found no C compiler, expected cc, gcc, clang or $CC")
        else:
            good = compile_and_replay(name, found, compiler) and good
    return good


def compile_and_replay(name, found, compiler):
    """Compile the C files of a folder in the bundle, and check that they reproduce the test vectors."""
    try:
        with tempfile.TemporaryDirectory() as build_folder:
            sources = read_c_files(name, found)
            for file, content in [*sources.items(), ("vectors.csv", found["vectors.csv"])]:
                with open(os.path.join(build_folder, file), "wb") as copy:
                    copy.write(content)
            files = C_FILES if name == "c99" else [file for file in sources if file.endswith(".c")]
            program = os.path.join(build_folder, "test_vectors")
            for command in ([compiler, *C_FLAGS, "-o", program, *files, "-lm"], [program, "vectors.csv"]):
                done = subprocess.run(
                    command, capture_output=True, text=True, errors="replace", check=False, cwd=build_folder
                )
                lines = (done.stdout + done.stderr).strip().split("\n")
                if done.returncode:
                    reported = next((line for line in lines if "error" in line), lines[0])
                    return report_failure(
                        name, escape_unprintable(reported) or f"exit code {done.returncode}"
                    )
    except Exception as error:
        return report_failure(name, f"cannot be compiled and run: {describe_error(error)}")
    return report_pass(name, escape_unprintable(lines[-1]))


def read_c_files(name, found):
    """Return the C files of a folder in the bundle and those in the archive of its FMU, by file name."""
    files = {path: content for path, content in found.items() if path.startswith(f"{name}/")}
    if C_FOLDERS[name]:
        with zipfile.ZipFile(io.BytesIO(found[C_FOLDERS[name]])) as archive:
            files.update({path: archive.read(path) for path in archive.namelist()})
    return {os.path.basename(path): files[path] for path in files if path.endswith((".c", ".h"))}


def read_plain_file(folder, name, most=MAX_BUNDLE_BYTES):
    """Return the content of a regular file in the folder; raise an error for links, pipes and devices."""
    path, parts = folder, name.split("/")
    for index, part in enumerate(parts, start=1 - len(parts)):
        path = os.path.join(path, part)
        if not (stat.S_ISDIR if index else stat.S_ISREG)(os.lstat(path).st_mode):
            raise ValueError("the path contains a link, or is not a regular file")
    flags = (getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))
    with open(os.open(path, os.O_RDONLY | sum(flags)), "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_size > most:
            raise ValueError(f"the path is not a regular file of at most {most} bytes")
        return file.read(status.st_size)


def try_read_file(found, folder, name, most):
    """Read a file into the dictionary `found`; return [(path, reason)] after an error, else an empty list."""
    try:
        found[name] = read_plain_file(folder, name, most)
    except (OSError, ValueError) as error:
        return [(name, f"cannot be read: {getattr(error, 'strerror', None) or error}")]
    return []


def report_pass(name, text):
    """Print that a check has passed; return True."""
    print(f"ok    {escape_unprintable(name)}: {text}")
    return True


def report_failure(name, text):
    """Print that a check has failed, and why; return None, which counts as false."""
    print(f"FAIL  {escape_unprintable(name)}: {text}")


def describe_error(error):
    """Return type and message of an error in one printable line."""
    return escape_unprintable(f"{type(error).__name__}: {error}")[:200]


def format_value(value):
    """Return a value as a printable text of at most 80 characters."""
    return escape_unprintable(value if isinstance(value, str) else repr(value))[:80]


def escape_unprintable(text):
    """Escape all characters of a text that are not printable ASCII."""
    return "".join(c if c.isprintable() and c.isascii() else ascii(c)[1:-1] for c in text)


def check_this_file():
    """Check the SHA-256 of this file again: damage to this file could have disabled the checks above."""
    here = os.path.dirname(os.path.abspath(__file__))
    try:
        manifest = json.loads(read_plain_file(here, "manifest.json", MAX_TEXT_BYTES))
        digest = manifest["files"]["selftest.py"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # the checks above have reported this error
    if hashlib.sha256(read_plain_file(here, os.path.basename(__file__))).hexdigest() != digest:
        sys.exit("FAIL  selftest.py: differs from what was exported: do not trust its results")


def report_exception(kind, error, trace):
    """Print an unexpected error in one line, instead of a traceback."""
    sys.stdout.flush()
    print(f"FAIL  selftest.py: cannot be run: {describe_error(error)}", file=sys.stderr)


if __name__ == "__main__":
    sys.excepthook = report_exception
    if {*sys.argv[1:]} - {"--c"}:
        sys.exit("usage: python selftest.py [--c]")
    good = main(sys.argv, os.path.dirname(os.path.abspath(__file__)))
    check_this_file()
    if not good:
        sys.exit("FAIL  the self-test")
check_this_file()
