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

MANIFEST, SIGNATURE, CACHE = "manifest.json", "manifest.sig", "__pycache__/"
PATH = re.compile(r"(?:\w[\w.-]{0,99}/){0,3}\w[\w.-]{0,99}", re.ASCII)  # path of a file in the manifest
# Limits of a bundle, and of a text file in it; no real bundle reaches them.
MOST_FILES, MOST_BYTES, MOST_TEXT = 1000, 1 << 26, 1 << 23
SCHEMA = "jaxhil/bundle/1"
SIMULATED_LIMIT = 1e-11  # share of the range of a run's commands; the simulation rounds in another order
MOST_SHOWN = 8  # largest number of reported differences of one kind
C_SOURCES = ("c99/test_vectors.c", "c99/jaxhil_controller.c")
C_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
COLUMNS = (
    "run,event,force_measured,position_desired,velocity_desired,position_measured,time,position,velocity,"
    "acceleration,force_command,position_command,faults,force_simulated"
)


def main(arguments, folder):
    """Run the checks on the bundle in `folder`; return True if all are good."""
    print(f"self-test of {plain(os.path.basename(os.path.abspath(folder)))}, Python {sys.version.split()[0]}")
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
    found, problems = differences(folder)
    reported = {}
    for name, text in problems:
        if name.endswith(CACHE):
            print(f"note  {plain(name)}: {text}")  # Python creates this when the controller runs
            continue
        reported[name] = reported.get(name, 0) + 1
        if reported[name] <= MOST_SHOWN:
            fail(name, text)
    for name, number in reported.items():
        if number > MOST_SHOWN:
            fail(name, f"and {number - MOST_SHOWN} more")
    if not reported:
        passed(MANIFEST, f"{len({*found} - {MANIFEST, SIGNATURE})} files are as they were exported")
        signed = "is signed; only `jaxhil verify --key` proves by whom"
        print(f"note  {MANIFEST}: {signed if SIGNATURE in found else 'is not signed'}")
    return found, {*reported}


def differences(folder):
    """Return the content of each file by its path, and (path, difference in words) for each difference."""
    found, problems, wrong, left = {}, [], [], MOST_BYTES
    if os.path.lexists(os.path.join(folder, SIGNATURE)):
        problems += take(found, folder, SIGNATURE, 64)  # bytes of an Ed25519 signature
    try:
        found[MANIFEST] = read(folder, MANIFEST, MOST_TEXT)
        wrong = [(MANIFEST, text) for text in manifest_differences(found[MANIFEST])]
        files, values = entries(found[MANIFEST])
    except Exception as error:
        return found, [*problems, *wrong, (MANIFEST, f"cannot be read: {describe(error)}")]
    if wrong:
        return found, problems + wrong  # a damaged manifest says nothing about other files
    for name, entry in files.items():
        problems += take(found, folder, name, left)
        content = found.get(name, b"")
        left -= len(content)
        same = len(content) == entry["bytes"] and hashlib.sha256(content).hexdigest() == entry["sha256"]
        if name in found and not same:
            problems += [(name, text) for text in lines_that_differ(content, entry.get("lines"))]
            if name == "gains.json":
                problems += [(name, text) for text in value_differences(content, values)]
    for name in others(folder, files):
        compiled = "holds compiled code, which is not checked: take it out before use"
        problems.append((name, compiled if name.endswith(CACHE) else "is no file of this bundle"))
    return found, problems


def entries(manifest):
    """Return the entry of each file, and the values of the gain file; raise an error for a wrong manifest."""
    document = json.loads(manifest)
    if document["schema"] != SCHEMA:
        raise ValueError(f"schema: found {shown(document['schema'])}, expected '{SCHEMA}'")
    files, values = document["files"], document["values"]
    for name, entry in files.items():
        if not PATH.fullmatch(name) or name in (MANIFEST, SIGNATURE):
            raise ValueError(f"'{shown(name)}' is no path of a file of a bundle")
        if (type(entry["sha256"]), type(entry["bytes"]), type(entry.get("lines", ""))) != (str, int, str):
            raise ValueError("not the entries of a manifest")
    if len(files) > MOST_FILES or sum(entry["bytes"] for entry in files.values()) > MOST_BYTES:
        raise ValueError(f"more than {MOST_FILES} files or {MOST_BYTES} bytes")
    return files, dict(values)


def manifest_differences(content):
    """Check a manifest against the checks of its lines at its end; return the differences in words."""
    body, found, seal = content.rpartition(b',\n "own_lines": ')
    try:
        own = json.loads(b'{"own_lines": ' + seal) if found else {}
        if hashlib.sha256(body).hexdigest() == own["own_sha256"]:
            # A seal with the same values in another notation is not the exported one.
            good = seal == own_seal(body).partition(b',\n "own_lines": ')[2]
            line = body.count(b"\n") + 2
            return [] if good else [f"line {line} or after: its own checks differ"]
        return lines_that_differ(body, own["own_lines"])
    except Exception:
        return ["its own checks at its end differ"]


def own_seal(body):
    """Return the end of a manifest: a check of each line of its body, and the body's SHA-256."""
    checks = json.dumps(line_checks(body))
    return f',\n "own_lines": {checks},\n "own_sha256": "{hashlib.sha256(body).hexdigest()}"\n}}\n'.encode()


def line_checks(content):
    """Return the CRC-32 of every line as eight hexadecimal digits; line endings do not count."""
    lines = content.replace(b"\r\n", b"\n").split(b"\n")
    return " ".join(f"{zlib.crc32(line):08x}" for line in lines)


def lines_that_differ(found, checks):
    """Return in words which lines of a file differ from their checks."""
    if checks is None or len(found) > MOST_TEXT:
        return [f"differs from what was exported ({len(found)} bytes are here)"]
    here, expected = line_checks(found).split(), checks.split()
    if here == expected:
        return ["its line endings differ from those exported"]
    if len(here) == len(expected):
        pairs = enumerate(zip(here, expected, strict=True), start=1)
        return [f"line {number}: differs from what was exported" for number, (a, b) in pairs if a != b]
    shorter = min(len(here), len(expected))
    first = next((place for place in range(shorter) if here[place] != expected[place]), shorter)
    return [f"line {first + 1}: differs from what was exported; {len(here)} lines, expected {len(expected)}"]


def value_differences(content, expected):
    """Yield the key, the value found and the value expected of each changed value in a gain file."""
    try:
        found = dict(leaves(json.loads(content), ""))
    except Exception:
        return
    for key in sorted({*expected, *found}):
        here, there = (shown(values.get(key, "nothing")) for values in (found, expected))
        if found.get(key) != expected.get(key):
            yield f"{plain(key)}: found {here}, expected {there}"


def leaves(value, key):
    """Yield (dotted key, value as JSON) for all values in a JSON document."""
    if isinstance(value, (dict, list)) and value:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for name, inner in items:
            yield from leaves(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, json.dumps(value)


def others(folder, files, within=""):
    """Yield the paths of files and folders that the manifest does not name; folders end with a slash."""
    for entry in sorted(os.scandir(os.path.join(folder, within)), key=lambda one: one.name):
        path, is_folder = within + entry.name, entry.is_dir(follow_symlinks=False)
        if is_folder and any(name.startswith(f"{path}/") for name in files):
            yield from others(folder, files, f"{path}/")
        elif is_folder or path not in {*files, MANIFEST, SIGNATURE}:
            yield f"{path}/" if is_folder else path


def check_runtime(folder, found, damaged):
    """Run the checked source of the runtime, and return its names; None if it does not run."""
    if {"jaxhil_runtime.py", MANIFEST} & damaged:
        return fail("jaxhil_runtime.py", "is not run: it, or the manifest, differs from what was exported")
    runtime = {"__name__": "jaxhil_runtime", "__file__": os.path.join(folder, "jaxhil_runtime.py")}
    try:
        # An import could load the cache of an older source, and with -I it would not find the folder.
        exec(compile(found["jaxhil_runtime.py"], "jaxhil_runtime.py", "exec"), runtime)
        if not {"Controller", "GainFileError"} <= {*runtime}:
            raise NameError("it has no Controller or no GainFileError")
    except BaseException as error:
        return fail("jaxhil_runtime.py", f"cannot be run: {describe(error)}")
    return runtime


def check_gains(folder, runtime):
    """Check that the controller accepts the gain file."""
    try:
        controller = runtime["Controller"].from_file(os.path.join(folder, "gains.json"))
    except runtime["GainFileError"] as error:
        return fail("gains.json", plain(str(error)))
    except BaseException as error:
        return fail("gains.json", f"cannot be loaded: {describe(error)}")
    law = " ".join(runtime.get("COMPENSATORS", ()))
    return passed("gains.json", f"loads: {law}, control period {controller.control_period!r} s")


def check_vectors(folder, found, runtime):
    """Check that every command equals the recorded one to the last bit, and is close to the simulated one."""
    try:
        rows = list(read_vectors(found["vectors.csv"].decode("ascii")))
    except Exception as error:
        return fail("vectors.csv", f"cannot be read: {describe(error)}")
    if not rows:
        return fail("vectors.csv", "has no tick")
    try:
        runs, different = replay(rows, os.path.join(folder, "gains.json"), runtime)
    except BaseException as error:
        return fail("vectors.csv", f"cannot be replayed: {describe(error)}")
    for text in different[:MOST_SHOWN]:
        fail("vectors.csv", text)
    if different:
        return fail("vectors.csv", f"{len(different)} of {len(rows)} ticks differ")
    passed("vectors.csv", f"{len(rows)} ticks of {len(runs)} runs, the same bit for bit")
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
            if not error <= SIMULATED_LIMIT * span:
                text = f"run {run}: force {force!r} N, simulated {simulated!r} N"
                return fail("vectors.csv", f"line {number}: {text}, beyond {SIMULATED_LIMIT} of {span!r} N")
            largest = max(largest, error / span if span else 0.0)
    text = f"the simulation's forces are met to {largest:.1e} of their range on {compared} ticks"
    return passed("vectors.csv", text) if compared else fail("vectors.csv", "has no simulated force")


def read_vectors(text):
    """Yield (line number, the row's numbers) for each tick; an empty field is None."""
    lines = text.split("\n")
    if lines[0].rstrip("\r") != COLUMNS:
        raise ValueError("line 1: unknown columns")
    width = COLUMNS.count(",") + 1
    for number, line in enumerate(lines[1:], start=2):
        if number == len(lines) and not line:
            return
        fields = line.rstrip("\r").split(",")
        try:
            row = [float(field) if field else None for field in fields]
        except ValueError:
            row = []
        if len(row) != width or any(one is None for place, one in enumerate(row) if place != 6):
            raise ValueError(f"line {number}: not a row of {width} numbers")
        yield number, row


def replay(rows, gains, runtime):
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
            for name, one, expected in zip(COLUMNS.split(",")[10:13], found, row[10:13], strict=True)
            if not same_bits(one, expected)
        ]
        if texts:
            different.append(f"line {number}, run {int(run)}: {', '.join(texts)}")
        runs.setdefault(int(run), []).append((number, command, row[13]))
    return runs, different


def same_bits(found, expected):
    """Return whether two floats are equal, including the sign of zero; any NaN equals any other."""
    both_nan = found != found and expected != expected
    return both_nan or struct.pack("<d", found) == struct.pack("<d", expected)


def check_c(folder, found, damaged):
    """Compile the C controller, and check that it reproduces the vectors."""
    sources = [os.path.join(folder, name) for name in C_SOURCES]
    differs = any(name == MANIFEST or name.startswith("c99/") for name in damaged)
    if differs or not {*C_SOURCES} <= {*found}:
        return fail("c99", "differs or is not here, so it is not compiled")
    compiler = shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return fail("c99", "no C compiler is here (cc, gcc, clang, or $CC)")
    try:
        with tempfile.TemporaryDirectory() as place:
            program = os.path.join(place, "test_vectors")
            vectors = os.path.join(os.path.abspath(folder), "vectors.csv")
            for command in ([compiler, *C_FLAGS, "-o", program, *sources, "-lm"], [program, vectors]):
                done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
                lines = (done.stdout + done.stderr).replace(vectors, "vectors.csv").strip().split("\n")
                if done.returncode:
                    reported = next((line for line in lines if "error" in line), lines[0])
                    return fail("c99", plain(reported) or f"exit code {done.returncode}")
    except Exception as error:
        return fail("c99", f"cannot be compiled and run: {describe(error)}")
    return passed("c99", plain(lines[-1]))


def read(folder, name, most=MOST_BYTES):
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


def take(found, folder, name, most):
    """Read a file into `found`; return a list with (path, reason) if that is not possible."""
    try:
        found[name] = read(folder, name, most)
    except (OSError, ValueError) as error:
        return [(name, f"cannot be read: {getattr(error, 'strerror', None) or error}")]
    return []


def passed(name, text):
    """Print that a check is good; return True."""
    print(f"ok    {plain(name)}: {text}")
    return True


def fail(name, text):
    """Print in one line what is wrong; return None, which counts as a failure."""
    print(f"FAIL  {plain(name)}: {text}")


def describe(error):
    """Return an error as text in one line."""
    return plain(f"{type(error).__name__}: {error}")[:200]


def shown(value):
    """Return a value as a short printable text."""
    return plain(value if isinstance(value, str) else repr(value))[:80]


def plain(text):
    """Return text with escapes for characters that a terminal may not print."""
    return "".join(c if c.isprintable() and c.isascii() else ascii(c)[1:-1] for c in text)


def look_again():
    """Check this file against the manifest without the functions above, which may be damaged."""
    here = os.path.dirname(os.path.abspath(__file__))
    try:
        own = json.loads(read(here, "manifest.json", MOST_TEXT))["files"]["selftest.py"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # the checks above have reported
    if hashlib.sha256(read(here, os.path.basename(__file__))).hexdigest() != own:
        sys.exit("FAIL  selftest.py: differs from what the manifest says, and is not to be believed")


def tell(kind, error, trace):
    """Report an unexpected error in one line."""
    sys.stdout.flush()
    print(f"FAIL  selftest.py: cannot be run: {describe(error)}", file=sys.stderr)


if __name__ == "__main__":
    sys.excepthook = tell
    if {*sys.argv[1:]} - {"--c"}:
        sys.exit("usage: python selftest.py [--c]")
    good = main(sys.argv, os.path.dirname(os.path.abspath(__file__)))
    look_again()
    if not good:
        sys.exit("FAIL  the self-test")
look_again()
