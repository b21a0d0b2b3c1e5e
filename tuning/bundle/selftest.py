"""Is this bundle as it was exported, and does its controller command here what it commanded there?

    python selftest.py          the files, the gains, and every test vector through jaxhil_runtime.py
    python selftest.py --c      also the C controller, with the C compiler that is here (cc, or $CC)

Python 3.11 or later alone. One line a check; exit code 0 if all are good, else 1.
"""

import hashlib
import json
import math
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib

MANIFEST = "manifest.json"
SCHEMA = "jaxhil/bundle/1"
SIMULATED_LIMIT = 1e-11  # of the range of a run's commands: the simulation rounds in another order
MOST_SHOWN = 8  # differences of one kind that are reported one by one
C_SOURCES = ("test_vectors.c", "jaxhil_controller.c")
C_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
COLUMNS = (
    "run,event,force_measured,position_desired,velocity_desired,position_measured,time,position,velocity,"
    "acceleration,force_command,position_command,faults,force_simulated"
)


def main(arguments, folder):
    """Run the checks on the bundle in `folder`; True if all are good."""
    print(f"self-test of {plain(os.path.basename(os.path.abspath(folder)))}, Python {sys.version.split()[0]}")
    damaged = check_files(folder)
    good = not damaged
    runtime = check_runtime(folder, damaged)
    if runtime is None or not check_gains(folder, runtime) or not check_vectors(folder, runtime):
        good = False
    if "--c" in arguments and not check_c(folder, damaged):
        good = False
    print("PASSED" if good else "FAILED: this bundle is not to be used on a rig")
    return good


def check_files(folder):
    """Every file against the manifest; the names of those that differ, all of them reported."""
    files, problems = differences(folder)
    reported = {}
    for name, text in problems:
        reported[name] = reported.get(name, 0) + 1
        if reported[name] <= MOST_SHOWN:
            fail(name, text)
    for name, number in reported.items():
        if number > MOST_SHOWN:
            fail(name, f"and {number - MOST_SHOWN} more")
    if not problems:
        passed(MANIFEST, f"{len(files)} files are as they were exported")
    return set(reported)


def differences(folder):
    """The manifest's files, and (name, what differs) of each difference from it."""
    problems = []
    try:
        content = read(os.path.join(folder, MANIFEST))
        problems = [(MANIFEST, text) for text in manifest_differences(content)]
        document = json.loads(content)
        if document["schema"] != SCHEMA:
            raise ValueError(f"schema: found {shown(document['schema'])}, expected '{SCHEMA}'")
        files, values = document["files"], document["values"]
        kinds = [
            (type(name), type(entry["sha256"]), type(entry.get("lines", ""))) for name, entry in files.items()
        ]
        if {*kinds} - {(str, str, str)} or not isinstance(values, dict):
            raise ValueError("not the entries of a manifest")
    except Exception as error:
        return {}, [*problems, (MANIFEST, f"cannot be read: {describe(error)}")]
    if problems:
        return files, problems  # nothing is to be learnt from it about others
    for name, entry in files.items():
        try:
            found = read(os.path.join(folder, *name.split("/")))
        except (OSError, ValueError) as error:
            problems.append((name, f"cannot be read: {getattr(error, 'strerror', None) or 'no such file'}"))
            continue
        if hashlib.sha256(found).hexdigest() != entry["sha256"]:
            lines = lines_that_differ(found, entry.get("lines"))
            problems += [(name, text) for text in lines]
            if name == "gains.json":
                problems += [(name, text) for text in value_differences(found, values)]
    problems += [(name, "is no file of this bundle") for name in unknown_files(folder, files)]
    return files, problems


def manifest_differences(content):
    """The manifest's last lines hold checks of all lines before."""
    body, found, seal = content.rpartition(b',\n "own_lines": ')
    try:
        own = json.loads(b'{"own_lines": ' + seal) if found else {}
        if hashlib.sha256(body).hexdigest() == own["own_sha256"]:
            # A seal written in another way seals as well, but is not the one that was exported.
            good = seal == own_seal(body).partition(b',\n "own_lines": ')[2]
            line = body.count(b"\n") + 2
            return [] if good else [f"line {line} or after: its own checks differ"]
        return lines_that_differ(body, own["own_lines"])
    except Exception:
        return ["its own checks at its end differ"]


def own_seal(body):
    """What follows a manifest's body: a check of each of its lines, and of the whole."""
    checks = json.dumps(line_checks(body))
    return f',\n "own_lines": {checks},\n "own_sha256": "{hashlib.sha256(body).hexdigest()}"\n}}\n'.encode()


def line_checks(content):
    """CRC-32 of every line, eight hexadecimal digits each, blanks between; line endings do not count."""
    lines = content.replace(b"\r\n", b"\n").split(b"\n")
    return " ".join(f"{zlib.crc32(line):08x}" for line in lines)


def lines_that_differ(found, checks):
    """In words, where a file's content differs from the lines whose checks these are."""
    if checks is None:
        return [f"differs from what was exported ({len(found)} bytes are here)"]
    here, expected = line_checks(found).split(), checks.split()
    if here == expected:
        return ["its line endings differ from those exported"]
    if len(here) == len(expected):
        pairs = enumerate(zip(here, expected, strict=True), start=1)
        return [f"line {number}: differs from what was exported" for number, (a, b) in pairs if a != b]
    first = next((i for i, (a, b) in enumerate(zip(here, expected, strict=False)) if a != b), None)
    first = min(len(here), len(expected)) if first is None else first
    return [f"line {first + 1}: differs from what was exported; {len(here)} lines, expected {len(expected)}"]


def value_differences(content, expected):
    """Each value of a gain file that is not the exported one: its key, what was found and expected."""
    try:
        found = dict(leaves(json.loads(content), ""))
    except Exception:
        return
    for key in sorted({*expected, *found}):
        if key not in expected:
            yield f"{plain(key)}: found {shown(found[key])}, expected nothing"
        elif key not in found:
            yield f"{key}: found nothing, expected {shown(expected[key])}"
        elif found[key] != expected[key]:
            yield f"{key}: found {shown(found[key])}, expected {shown(expected[key])}"


def leaves(value, key):
    """(dotted key, value as JSON) of all that is in a JSON value."""
    if isinstance(value, (dict, list)) and value:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for name, inner in items:
            yield from leaves(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, json.dumps(value)


def unknown_files(folder, files):
    """Files that the manifest does not name, but for Python's own caches."""
    for place, inner, names in os.walk(folder):
        inner[:] = sorted(name for name in inner if name != "__pycache__")
        for name in sorted(names):
            path = os.path.relpath(os.path.join(place, name), folder).replace(os.sep, "/")
            if path not in files and path != MANIFEST:
                yield path


def check_runtime(folder, damaged):
    """The runtime's names, from the source that is here and nothing else; None if it does not run."""
    if {"jaxhil_runtime.py", MANIFEST} & damaged:
        return fail("jaxhil_runtime.py", "is not run: it, or the manifest, differs from what was exported")
    path = os.path.join(folder, "jaxhil_runtime.py")
    runtime = {"__name__": "jaxhil_runtime", "__file__": path}
    try:
        # Not by import: a cache of an older source may lie about, and the folder is on no path with -I.
        exec(compile(read(path), "jaxhil_runtime.py", "exec"), runtime)
        if not {"Controller", "GainFileError"} <= {*runtime}:
            raise NameError("it has no Controller or no GainFileError")
    except BaseException as error:
        return fail("jaxhil_runtime.py", f"cannot be run: {describe(error)}")
    return runtime


def check_gains(folder, runtime):
    """The gain file is one that the controller takes."""
    try:
        controller = runtime["Controller"].from_file(os.path.join(folder, "gains.json"))
    except runtime["GainFileError"] as error:
        return fail("gains.json", plain(str(error)))
    except BaseException as error:
        return fail("gains.json", f"cannot be loaded: {describe(error)}")
    law = " ".join(runtime.get("COMPENSATORS", ()))
    return passed("gains.json", f"loads: {law}, control period {controller.control_period!r} s")


def check_vectors(folder, runtime):
    """Every tick commands what was recorded, to the bit; the simulation's forces are met closely."""
    try:
        rows = list(read_vectors(read(os.path.join(folder, "vectors.csv")).decode("ascii")))
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
    """The forces commanded against those that the simulation commanded, run by run."""
    largest, compared = 0.0, 0
    for run, ticks in runs.items():
        expected = [simulated for _, _, simulated in ticks if not math.isnan(simulated)]
        compared += len(expected)
        span = max(0.0, *expected) - min(0.0, *expected) if expected else 0.0
        for number, force, simulated in ticks:
            if math.isnan(simulated):
                continue
            error = abs(force - simulated)
            if not error <= SIMULATED_LIMIT * span:
                text = f"run {run}: force {force!r} N, simulated {simulated!r} N"
                return fail("vectors.csv", f"line {number}: {text}, beyond {SIMULATED_LIMIT} of {span!r} N")
            largest = max(largest, error / span if span else 0.0)
    text = f"the simulation's forces are met to {largest:.1e} of their range on {compared} ticks"
    return passed("vectors.csv", text) if compared else fail("vectors.csv", "has no simulated force")


def read_vectors(text):
    """(line number, the row's numbers) of each tick; an empty field is None."""
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
            raise ValueError(f"line {number}: not a row of numbers") from None
        if len(row) != width or any(one is None for place, one in enumerate(row) if place != 6):
            raise ValueError(f"line {number}: not a row of {width} numbers")
        yield number, row


def replay(rows, gains, runtime):
    """Of each run (line, force commanded, simulated) of its ticks; the differences, in words."""
    controller, runs, different = None, {}, []
    for number, row in rows:
        run, event, force, position, velocity, measured, time, *motion = row[:10]
        if event == 1:
            controller = runtime["Controller"].from_file(gains)
        elif controller is None or event not in (0, 2):
            raise ValueError(f"line {number}: event {event!r}, expected 0, 1 or 2, the first tick's 1")
        elif event == 2:
            controller.next_contact()
        # An integer in the file stands for the bits of the faults; all else are floats.
        found_force = controller.step(force, position, velocity, measured, time)
        found_position = controller.position_command(*motion)
        found_faults = float(controller.faults)
        pairs = zip(
            ("force_command", "position_command", "faults"),
            (found_force, found_position, found_faults),
            row[10:13],
            strict=True,
        )
        texts = [
            f"{name}: found {found!r}, expected {expected!r}"
            for name, found, expected in pairs
            if not same_bits(found, expected)
        ]
        if texts:
            different.append(f"line {number}, run {int(run)}: {', '.join(texts)}")
        runs.setdefault(int(run), []).append((number, found_force, row[13]))
    return runs, different


def same_bits(found, expected):
    """Whether two floats are the same, signs of zero included; any NaN is as another."""
    if found != found and expected != expected:
        return True
    return struct.pack("<d", found) == struct.pack("<d", expected)


def check_c(folder, damaged):
    """The C controller, compiled here, meets the vectors too."""
    sources = [os.path.join(folder, "c99", name) for name in C_SOURCES]
    if any(name.startswith("c99/") for name in damaged) or not all(map(os.path.isfile, sources)):
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


def read(path):
    with open(path, "rb") as file:
        return file.read()


def passed(name, text):
    print(f"ok    {plain(name)}: {text}")
    return True


def fail(name, text):
    """Tell what is wrong, in one line; None, which is no success."""
    print(f"FAIL  {plain(name)}: {text}")


def describe(error):
    """An error in one line."""
    return plain(f"{type(error).__name__}: {error}")[:200]


def shown(value):
    return plain(value if isinstance(value, str) else repr(value))[:80]


def plain(text):
    """Text that any terminal can print, on one line."""
    return "".join(c if c.isprintable() and c.isascii() else ascii(c)[1:-1] for c in text)


def look_again():
    """This file against the manifest once more, apart from all the above: it may be what is damaged."""
    here = os.path.dirname(os.path.abspath(__file__))
    try:
        own = json.loads(read(os.path.join(here, "manifest.json")))["files"]["selftest.py"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # the checks above have reported
    if hashlib.sha256(read(os.path.abspath(__file__))).hexdigest() != own:
        sys.exit("FAIL  selftest.py: differs from what the manifest says, and is not to be believed")


def tell(kind, error, trace):
    """What is reported of an error that nothing expected: one line."""
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
