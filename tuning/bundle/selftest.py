"""Self-test of a bundle: program that checks the files and replays recorded ticks through the controller.

    python selftest.py          check the files and the gains, and replay all test vectors in Python
    python selftest.py --c      also compile the C controller (with cc or $CC) and replay them in C

The program needs only Python 3.11 or later. It prints one line per check. The exit code is 0 if all checks
pass, else 1. The program cannot show who exported the bundle: use `jaxhil verify --key` on a workstation.
"""

import hashlib
import json
import math
import os
import re
import shutil
import stat
import struct
import subprocess
import sys
import tempfile
import zlib
from collections import namedtuple

MANIFEST_FILE, SIGNATURE_FILE, PYTHON_CACHE = "manifest.json", "manifest.sig", "__pycache__/"
# Pattern of a file's path in the manifest.
PATH_PATTERN = re.compile(r"(?:\w[\w.-]{0,99}/){0,3}\w[\w.-]{0,99}", re.ASCII)
# Limits of a bundle: files and bytes; and bytes of a text file in it.
MAX_FILES, MAX_BUNDLE_BYTES, MAX_TEXT_BYTES = 1000, 1 << 26, 1 << 23
SCHEMA = "jaxhil/bundle/1"
MAX_REPORTED_DIFFERENCES = 8  # largest number of reported differences in one file
C_SOURCES = ("c99/test_vectors.c", "c99/jaxhil_controller.c")
C_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
VECTOR_COLUMNS = (
    "run,event,force_measured,position_desired,velocity_desired,position_measured,time,position,velocity,"
    "acceleration,force_command,position_command,faults,force_simulated"
)
VECTORS_BEFORE_TIME = ("wrench_measured", "pose_desired", "twist_desired", "pose_measured")
VECTORS_AFTER_TIME = ("pose", "twist", "wrench_command", "pose_command")
COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
SIX_AXIS_VECTOR_COLUMNS = ",".join(
    [
        "run,event",
        *(f"{name}_{axis}" for name in VECTORS_BEFORE_TIME for axis in COORDINATES),
        "time",
        *(f"{name}_{axis}" for name in VECTORS_AFTER_TIME for axis in COORDINATES),
        "faults",
        *(f"wrench_simulated_{axis}" for axis in COORDINATES),
    ]
)
# Layout of vectors.csv for a controller: its columns; numbers of each quantity; number of quantities after
# the time that describe the model's motion; the method that commands the drives; parts of a force command
# with a common range and unit; largest difference between runtime and simulation, divided by the range of a
# run's commands [1] (the simulation rounds in another order).
Layout = namedtuple("Layout", "columns width motions method parts error")
LAYOUTS = {
    "Controller": Layout(VECTOR_COLUMNS, 1, 3, "position_command", ((0, 1, "N"),), 1e-11),
    "Controller6": Layout(SIX_AXIS_VECTOR_COLUMNS, 6, 2, "pose_command", ((0, 3, "N"), (3, 6, "N m")), 1e-9),
}


def main(arguments, folder):
    """Run all checks on the bundle in `folder`; return True if all checks pass."""
    print(
        f"self-test of {escape_unprintable(os.path.basename(os.path.abspath(folder)))}, Python "
        f"{sys.version.split()[0]}"
    )
    found, damaged = check_files(folder)
    runtime = check_runtime(folder, found, damaged)
    runs = runtime is not None and "gains.json" in found
    agrees = runs and check_gains(folder, runtime) and check_vectors(folder, found, runtime)
    agrees_in_c = "--c" not in arguments or check_c(folder, found, damaged)
    good = not damaged and agrees is agrees_in_c is True
    print("PASSED" if good else "FAILED: do not use this bundle on a rig")
    return good


def check_files(folder):
    """Check every file against the manifest; return the files' contents, and the names of differing files."""
    found, problems = find_differences(folder)
    reported = {}
    for name, text in problems:
        if name.endswith(PYTHON_CACHE):
            print(f"note  {escape_unprintable(name)}: {text}")  # Python creates this when the controller runs
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
    """Compare all files with the manifest.

    Return the content of each file by its path, and a list of (path, description) of the differences.
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
    """Yield a text for each value of the gain file that differs: key, found value and expected value."""
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


def check_runtime(folder, found, damaged):
    """Execute the checked source of the runtime; return its namespace, or None after an error."""
    if {"jaxhil_runtime.py", MANIFEST_FILE} & damaged:
        return report_failure(
            "jaxhil_runtime.py",
            "is not executed, because this file or the manifest differs from what was exported",
        )
    runtime = {"__name__": "jaxhil_runtime", "__file__": os.path.join(folder, "jaxhil_runtime.py")}
    try:
        # An import statement could load a cached older version, and does not find this folder with -I.
        exec(compile(found["jaxhil_runtime.py"], "jaxhil_runtime.py", "exec"), runtime)
        if "GainFileError" not in runtime or not {*LAYOUTS} & {*runtime}:
            raise NameError("Controller or GainFileError is missing")
    except BaseException as error:
        return report_failure("jaxhil_runtime.py", f"cannot be executed: {describe_error(error)}")
    return runtime


def check_gains(folder, runtime):
    """Check that the controller accepts the gain file."""
    try:
        controller = runtime[controller_name(runtime)].from_file(os.path.join(folder, "gains.json"))
    except runtime["GainFileError"] as error:
        return report_failure("gains.json", escape_unprintable(str(error)))
    except BaseException as error:
        return report_failure("gains.json", f"cannot be loaded: {describe_error(error)}")
    period = controller.control_period
    laws = runtime.get("COMPENSATORS") or runtime.get("SIX_AXIS_COMPENSATORS", ())
    return report_pass("gains.json", f"loads: {' '.join(laws)}, control period {period!r} s")


def controller_name(runtime):
    """Return the name of the runtime's controller."""
    return next(name for name in LAYOUTS if name in runtime)


def check_vectors(folder, found, runtime):
    """Replay the test vectors through the runtime, and compare its commands.

    Every command must equal the recorded command to the last bit, and be close to the simulated command.
    """
    try:
        layout = LAYOUTS[controller_name(runtime)]
        rows = list(read_vectors(found["vectors.csv"].decode("ascii"), layout))
    except Exception as error:
        return report_failure("vectors.csv", f"cannot be read: {describe_error(error)}")
    if not rows:
        return report_failure("vectors.csv", "contains no ticks")
    try:
        runs, different = replay_vectors(rows, os.path.join(folder, "gains.json"), runtime)
    except BaseException as error:
        return report_failure("vectors.csv", f"cannot be replayed: {describe_error(error)}")
    for text in different[:MAX_REPORTED_DIFFERENCES]:
        report_failure("vectors.csv", text)
    if different:
        return report_failure("vectors.csv", f"{len(different)} of {len(rows)} ticks differ")
    report_pass("vectors.csv", f"{len(rows)} ticks of {len(runs)} runs, the same bit for bit")
    return check_simulated(runs, layout)


def check_simulated(runs, layout):
    """Compare the force commands of each run with the simulated force commands."""
    largest, compared = 0.0, 0
    for run, ticks in runs.items():
        stated = [tick for tick in ticks if not any(map(math.isnan, tick[2]))]
        compared += len(stated)
        for first, last, unit in layout.parts:
            expected = [0.0, *(value for tick in stated for value in tick[2][first:last])]
            span = max(expected) - min(expected)
            for number, forces, commands in stated:
                for force, simulated in zip(forces[first:last], commands[first:last], strict=True):
                    error = abs(force - simulated)
                    if not error <= layout.error * span:
                        text = (
                            f"run {run}: force command: found {force!r} {unit}, expected {simulated!r} {unit}"
                        )
                        limit = f"within {layout.error} of the range {span!r} {unit}"
                        return report_failure("vectors.csv", f"line {number}: {text} {limit}")
                    largest = max(largest, error / span if span else 0.0)
    text = f"{compared} ticks, forces agree with the simulation within {largest:.1e} of their range"
    return (
        report_pass("vectors.csv", text)
        if compared
        else report_failure("vectors.csv", "contains no simulated forces")
    )


def read_vectors(text, layout=LAYOUTS["Controller"]):
    """Yield (line number, list of numbers) for each row of vectors.csv; an empty field becomes None."""
    lines = text.split("\n")
    if lines[0].rstrip("\r") != layout.columns:
        raise ValueError(f"line 1: unknown columns, expected {layout.columns}")
    width, time = layout.columns.count(",") + 1, 2 + 4 * layout.width
    for number, line in enumerate(lines[1:], start=2):
        if number == len(lines) and not line:
            return
        try:
            row = [float(field) if field else None for field in line.rstrip("\r").split(",")]
        except ValueError:
            row = []
        if len(row) != width or any(value is None for index, value in enumerate(row) if index != time):
            raise ValueError(f"line {number}: not a row of {width} numbers")
        yield number, row


def replay_vectors(rows, gains, runtime):
    """Replay all rows of vectors.csv through the runtime's controller with the gain file `gains`.

    Return a dictionary of lists of (line number, force command, simulated force command) for each run, each
    command as a list of numbers, and descriptions of the differences from the recorded commands.
    """
    name = controller_name(runtime)
    layout, controller, runs, different = LAYOUTS[name], None, {}, []
    width, time = layout.width, 2 + 4 * layout.width
    after = time + 1 + layout.motions * width
    columns = layout.columns.split(",")[after : after + 2 * width + 1]
    for number, row in rows:
        run, event = row[:2]
        if event == 1:
            controller = runtime[name].from_file(gains)
        elif controller is None or event not in (0, 2):
            raise ValueError(
                f"line {number}: event: found {event!r}, expected 0, 1 or 2, and 1 in the first row"
            )
        elif event == 2:
            controller.next_contact()
        command = controller.step(*quantities(row[2:time], width), row[time])
        sent = getattr(controller, layout.method)(*quantities(row[time + 1 : after], width))
        command, sent = ([command], [sent]) if width == 1 else (command, sent)
        # The faults are integers in the file, and are compared as floats like all other columns.
        found = [*command, *sent, float(controller.faults)]
        texts = [
            f"{column}: found {value!r}, expected {expected!r}"
            for column, value, expected in zip(columns, found, row[after:], strict=False)
            if not are_same_bits(value, expected)
        ]
        if texts:
            different.append(f"line {number}, run {int(run)}: {', '.join(texts)}")
        runs.setdefault(int(run), []).append((number, command, row[-width:]))
    return runs, different


def quantities(row, width):
    """Return the quantities of a row: numbers, or lists of `width` numbers."""
    if width == 1:
        return row
    return [row[index : index + width] for index in range(0, len(row), width)]


def are_same_bits(found, expected):
    """Return whether two floats are equal, including the sign of zero; any NaN equals any other."""
    both_nan = math.isnan(found) and math.isnan(expected)
    return both_nan or struct.pack("<d", found) == struct.pack("<d", expected)


def check_c(folder, found, damaged):
    """Compile the C controller, and check that it reproduces the test vectors."""
    sources = [os.path.join(folder, name) for name in C_SOURCES]
    differs = any(name == MANIFEST_FILE or name.startswith("c99/") for name in damaged)
    if differs or not {*C_SOURCES} <= {*found}:
        return report_failure("c99", "is not compiled, because a file is missing or differs")
    compiler = shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return report_failure("c99", "found no C compiler, expected cc, gcc, clang or $CC")
    try:
        with tempfile.TemporaryDirectory() as build_folder:
            program = os.path.join(build_folder, "test_vectors")
            vectors = os.path.join(os.path.abspath(folder), "vectors.csv")
            for command in ([compiler, *C_FLAGS, "-o", program, *sources, "-lm"], [program, vectors]):
                done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
                lines = (done.stdout + done.stderr).replace(vectors, "vectors.csv").strip().split("\n")
                if done.returncode:
                    reported = next((line for line in lines if "error" in line), lines[0])
                    return report_failure(
                        "c99", escape_unprintable(reported) or f"exit code {done.returncode}"
                    )
    except Exception as error:
        return report_failure("c99", f"cannot be compiled and run: {describe_error(error)}")
    return report_pass("c99", escape_unprintable(lines[-1]))


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
    """Check the SHA-256 of this file again, because a damaged check above could have accepted it."""
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
