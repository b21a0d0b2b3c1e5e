"""Self-test of a bundle: checks its files, and replays recorded ticks through its controller.

    python selftest.py          the files, the gains, and every test vector through jaxhil_runtime.py
    python selftest.py --c      also the C controller, with the local C compiler (cc, or $CC)

It needs only Python 3.11 or later, prints one line per check, and ends with exit code 0 if all are good, else
1. It cannot show who exported the bundle: for a signed one, use `jaxhil verify --key` on a workstation.
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

MANIFEST_FILE, SIGNATURE_FILE, PYTHON_CACHE = "manifest.json", "manifest.sig", "__pycache__/"
PATH_PATTERN = re.compile(
    r"(?:\w[\w.-]{0,99}/){0,3}\w[\w.-]{0,99}", re.ASCII
)  # path of a file in the manifest
MAX_FILES, MAX_BUNDLE_BYTES, MAX_TEXT_BYTES = (
    1000,
    1 << 26,
    1 << 23,
)  # of a bundle, and bytes of a text file in it
SCHEMA = "jaxhil/bundle/1"
MAX_SIMULATION_ERROR = 1e-11  # share of the range of a run's commands; the simulation rounds in another order
MAX_REPORTED_DIFFERENCES = 8  # largest number of reported differences of one kind
C_SOURCES = ("c99/test_vectors.c", "c99/jaxhil_controller.c")
C_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
VECTOR_COLUMNS = (
    "run,event,force_measured,position_desired,velocity_desired,position_measured,time,position,velocity,"
    "acceleration,force_command,position_command,faults,force_simulated"
)


def main(arguments, folder):
    """Run the checks on the bundle in `folder`; return True if all are good."""
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
    print("PASSED" if good else "FAILED: this bundle is not to be used on a rig")
    return good


def check_files(folder):
    """Check every file against the manifest; return the contents, and the names of files that differ."""
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
    """Return the content of each file by its path, and (path, difference in words) for each difference."""
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
        return found, problems + wrong  # a damaged manifest says nothing about other files
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
        compiled = "holds compiled code, which is not checked: take it out before use"
        problems.append((name, compiled if name.endswith(PYTHON_CACHE) else "is no file of this bundle"))
    return found, problems


def read_manifest_entries(manifest):
    """Return the entry of each file, and the values of the gain file; raise an error for a wrong manifest."""
    document = json.loads(manifest)
    if document["schema"] != SCHEMA:
        raise ValueError(f"schema: found {format_value(document['schema'])}, expected '{SCHEMA}'")
    files, values = document["files"], document["values"]
    for name, entry in files.items():
        if not PATH_PATTERN.fullmatch(name) or name in (MANIFEST_FILE, SIGNATURE_FILE):
            raise ValueError(f"'{format_value(name)}' is no path of a file of a bundle")
        if (type(entry["sha256"]), type(entry["bytes"]), type(entry.get("lines", ""))) != (str, int, str):
            raise ValueError("not the entries of a manifest")
    if len(files) > MAX_FILES or sum(entry["bytes"] for entry in files.values()) > MAX_BUNDLE_BYTES:
        raise ValueError(f"more than {MAX_FILES} files or {MAX_BUNDLE_BYTES} bytes")
    return files, dict(values)


def find_manifest_differences(content):
    """Check a manifest against the checks of its lines at its end; return the differences in words."""
    body, found, seal = content.rpartition(b',\n "own_lines": ')
    try:
        own = json.loads(b'{"own_lines": ' + seal) if found else {}
        if hashlib.sha256(body).hexdigest() == own["own_sha256"]:
            # A seal with the same values in another notation is not the exported one.
            good = seal == build_manifest_seal(body).partition(b',\n "own_lines": ')[2]
            line = body.count(b"\n") + 2
            return [] if good else [f"line {line} or after: its own checks differ"]
        return find_differing_lines(body, own["own_lines"])
    except Exception:
        return ["its own checks at its end differ"]


def build_manifest_seal(body):
    """Return the end of a manifest: a check of each line of its body, and the body's SHA-256."""
    checks = json.dumps(line_checksums(body))
    return f',\n "own_lines": {checks},\n "own_sha256": "{hashlib.sha256(body).hexdigest()}"\n}}\n'.encode()


def line_checksums(content):
    """Return the CRC-32 of every line as eight hexadecimal digits; line endings do not count."""
    lines = content.replace(b"\r\n", b"\n").split(b"\n")
    return " ".join(f"{zlib.crc32(line):08x}" for line in lines)


def find_differing_lines(found, checks):
    """Return in words which lines of a file differ from their checks."""
    if checks is None or len(found) > MAX_TEXT_BYTES:
        return [f"differs from what was exported ({len(found)} bytes are here)"]
    here, expected = line_checksums(found).split(), checks.split()
    if here == expected:
        return ["its line endings differ from those exported"]
    if len(here) == len(expected):
        pairs = enumerate(zip(here, expected, strict=True), start=1)
        return [f"line {number}: differs from what was exported" for number, (a, b) in pairs if a != b]
    first = [*(a == b for a, b in zip(here, expected, strict=False)), False].index(False)
    return [f"line {first + 1}: differs from what was exported; {len(here)} lines, expected {len(expected)}"]


def find_value_differences(content, expected):
    """Yield the key, the value found and the value expected of each changed value in a gain file."""
    try:
        found = dict(flatten_document(json.loads(content), ""))
    except Exception:
        return
    for key in sorted({*expected, *found}):
        here, there = (format_value(values.get(key, "nothing")) for values in (found, expected))
        if found.get(key) != expected.get(key):
            yield f"{escape_unprintable(key)}: found {here}, expected {there}"


def flatten_document(value, key):
    """Yield (dotted key, value as JSON) for all values in a JSON document."""
    if isinstance(value, (dict, list)) and value:
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from flatten_document(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, json.dumps(value)


def find_unlisted_paths(folder, files, within=""):
    """Yield the paths of files and folders that the manifest does not name; folders end with a slash."""
    for entry in sorted(os.scandir(os.path.join(folder, within)), key=lambda one: one.name):
        path, is_folder = within + entry.name, entry.is_dir(follow_symlinks=False)
        if is_folder and any(name.startswith(f"{path}/") for name in files):
            yield from find_unlisted_paths(folder, files, f"{path}/")
        elif is_folder or path not in {*files, MANIFEST_FILE, SIGNATURE_FILE}:
            yield f"{path}/" if is_folder else path


def check_runtime(folder, found, damaged):
    """Run the checked source of the runtime, and return its names; None if it does not run."""
    if {"jaxhil_runtime.py", MANIFEST_FILE} & damaged:
        return report_failure(
            "jaxhil_runtime.py", "is not run: it, or the manifest, differs from what was exported"
        )
    runtime = {"__name__": "jaxhil_runtime", "__file__": os.path.join(folder, "jaxhil_runtime.py")}
    try:
        # An import could load the cache of an older source, and with -I it would not find the folder.
        exec(compile(found["jaxhil_runtime.py"], "jaxhil_runtime.py", "exec"), runtime)
        if not {"Controller", "GainFileError"} <= {*runtime}:
            raise NameError("it has no Controller or no GainFileError")
    except BaseException as error:
        return report_failure("jaxhil_runtime.py", f"cannot be run: {describe_error(error)}")
    return runtime


def check_gains(folder, runtime):
    """Check that the controller accepts the gain file."""
    try:
        controller = runtime["Controller"].from_file(os.path.join(folder, "gains.json"))
    except runtime["GainFileError"] as error:
        return report_failure("gains.json", escape_unprintable(str(error)))
    except BaseException as error:
        return report_failure("gains.json", f"cannot be loaded: {describe_error(error)}")
    period, laws = controller.control_period, runtime.get("COMPENSATORS", ())
    return report_pass("gains.json", f"loads: {' '.join(laws)}, control period {period!r} s")


def check_vectors(folder, found, runtime):
    """Check that every command equals the recorded one to the last bit, and is close to the simulated one."""
    try:
        rows = list(read_vectors(found["vectors.csv"].decode("ascii")))
    except Exception as error:
        return report_failure("vectors.csv", f"cannot be read: {describe_error(error)}")
    if not rows:
        return report_failure("vectors.csv", "has no tick")
    try:
        runs, different = replay_vectors(rows, os.path.join(folder, "gains.json"), runtime)
    except BaseException as error:
        return report_failure("vectors.csv", f"cannot be replayed: {describe_error(error)}")
    for text in different[:MAX_REPORTED_DIFFERENCES]:
        report_failure("vectors.csv", text)
    if different:
        return report_failure("vectors.csv", f"{len(different)} of {len(rows)} ticks differ")
    report_pass("vectors.csv", f"{len(rows)} ticks of {len(runs)} runs, the same bit for bit")
    return check_simulated(runs)


def check_simulated(runs):
    """Check the commanded forces against those of the simulation, run by run."""
    largest, compared = 0.0, 0
    for run, ticks in runs.items():
        stated = [tick for tick in ticks if not math.isnan(tick[2])]
        expected = [0.0, *(simulated for _, _, simulated in stated)]
        compared, span = compared + len(stated), max(expected) - min(expected)
        for number, force, simulated in stated:
            error = abs(force - simulated)
            if not error <= MAX_SIMULATION_ERROR * span:
                text = f"run {run}: force {force!r} N, simulated {simulated!r} N"
                return report_failure(
                    "vectors.csv", f"line {number}: {text}, beyond {MAX_SIMULATION_ERROR} of {span!r} N"
                )
            largest = max(largest, error / span if span else 0.0)
    text = f"the simulation's forces are met to {largest:.1e} of their range on {compared} ticks"
    return (
        report_pass("vectors.csv", text)
        if compared
        else report_failure("vectors.csv", "has no simulated force")
    )


def read_vectors(text):
    """Yield (line number, the row's numbers) for each tick; an empty field is None."""
    lines = text.split("\n")
    if lines[0].rstrip("\r") != VECTOR_COLUMNS:
        raise ValueError("line 1: unknown columns")
    width = VECTOR_COLUMNS.count(",") + 1
    for number, line in enumerate(lines[1:], start=2):
        if number == len(lines) and not line:
            return
        try:
            row = [float(field) if field else None for field in line.rstrip("\r").split(",")]
        except ValueError:
            row = []
        if len(row) != width or any(one is None for place, one in enumerate(row) if place != 6):
            raise ValueError(f"line {number}: not a row of {width} numbers")
        yield number, row


def replay_vectors(rows, gains, runtime):
    """Return (line, commanded force, simulated force) of each tick by run, and the differences in words."""
    controller, runs, different = None, {}, []
    for number, row in rows:
        run, event, force, position, velocity, measured, time, *motion = row[:10]
        if event == 1:
            controller = runtime["Controller"].from_file(gains)
        elif controller is None or event not in (0, 2):
            raise ValueError(f"line {number}: event {event!r}, expected 0, 1 or 2, the first tick's 1")
        elif event == 2:
            controller.next_contact()
        command = controller.step(force, position, velocity, measured, time)
        # The faults are the only integers in the file; they are compared as floats.
        found = command, controller.position_command(*motion), float(controller.faults)
        texts = [
            f"{name}: found {one!r}, expected {expected!r}"
            for name, one, expected in zip(VECTOR_COLUMNS.split(",")[10:13], found, row[10:13], strict=True)
            if not are_same_bits(one, expected)
        ]
        if texts:
            different.append(f"line {number}, run {int(run)}: {', '.join(texts)}")
        runs.setdefault(int(run), []).append((number, command, row[13]))
    return runs, different


def are_same_bits(found, expected):
    """Return whether two floats are equal, including the sign of zero; any NaN equals any other."""
    both_nan = math.isnan(found) and math.isnan(expected)
    return both_nan or struct.pack("<d", found) == struct.pack("<d", expected)


def check_c(folder, found, damaged):
    """Compile the C controller, and check that it reproduces the vectors."""
    sources = [os.path.join(folder, name) for name in C_SOURCES]
    differs = any(name == MANIFEST_FILE or name.startswith("c99/") for name in damaged)
    if differs or not {*C_SOURCES} <= {*found}:
        return report_failure("c99", "differs or is not here, so it is not compiled")
    compiler = shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return report_failure("c99", "no C compiler is here (cc, gcc, clang, or $CC)")
    try:
        with tempfile.TemporaryDirectory() as place:
            program = os.path.join(place, "test_vectors")
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
    """Return the content of a plain file in the folder; links, pipes and devices are refused."""
    path, parts = folder, name.split("/")
    for place, part in enumerate(parts, start=1 - len(parts)):
        path = os.path.join(path, part)
        if not (stat.S_ISDIR if place else stat.S_ISREG)(os.lstat(path).st_mode):
            raise ValueError("it is no plain file in folders of the bundle")
    flags = (getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))
    with open(os.open(path, os.O_RDONLY | sum(flags)), "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_size > most:
            raise ValueError(f"it is no plain file of at most {most} bytes")
        return file.read(status.st_size)


def try_read_file(found, folder, name, most):
    """Read a file into `found`; return a list with (path, reason) if that is not possible."""
    try:
        found[name] = read_plain_file(folder, name, most)
    except (OSError, ValueError) as error:
        return [(name, f"cannot be read: {getattr(error, 'strerror', None) or error}")]
    return []


def report_pass(name, text):
    """Print that a check is good; return True."""
    print(f"ok    {escape_unprintable(name)}: {text}")
    return True


def report_failure(name, text):
    """Print in one line what is wrong; return None, which counts as a failure."""
    print(f"FAIL  {escape_unprintable(name)}: {text}")


def describe_error(error):
    """Return an error as text in one line."""
    return escape_unprintable(f"{type(error).__name__}: {error}")[:200]


def format_value(value):
    """Return a value as a short printable text."""
    return escape_unprintable(value if isinstance(value, str) else repr(value))[:80]


def escape_unprintable(text):
    """Return text with escapes for characters that a terminal may not print."""
    return "".join(c if c.isprintable() and c.isascii() else ascii(c)[1:-1] for c in text)


def look_again():
    """Check this file against the manifest without the functions above, which may be damaged."""
    here = os.path.dirname(os.path.abspath(__file__))
    try:
        manifest = json.loads(read_plain_file(here, "manifest.json", MAX_TEXT_BYTES))
        own = manifest["files"]["selftest.py"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # the checks above have reported
    if hashlib.sha256(read_plain_file(here, os.path.basename(__file__))).hexdigest() != own:
        sys.exit("FAIL  selftest.py: differs from what the manifest says, and is not to be believed")


def report_exception(kind, error, trace):
    """Report an unexpected error in one line."""
    sys.stdout.flush()
    print(f"FAIL  selftest.py: cannot be run: {describe_error(error)}", file=sys.stderr)


if __name__ == "__main__":
    sys.excepthook = report_exception
    if {*sys.argv[1:]} - {"--c"}:
        sys.exit("usage: python selftest.py [--c]")
    good = main(sys.argv, os.path.dirname(os.path.abspath(__file__)))
    look_again()
    if not good:
        sys.exit("FAIL  the self-test")
look_again()
