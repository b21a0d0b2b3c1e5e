"""Commands during which one system call fails, or at which the process is killed (`faults.c`).

A process that has finished all imports forks for every command; jax is started by the child. This file is
also the program of the parent process.
"""

import ctypes
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent
COMPILER = shutil.which("cc")
LONGEST = 120.0  # timeout of a command [s]
HANGS = "hangs"


class Ran(NamedTuple):
    """Result of a command."""

    code: int | str  # exit code, the negative of a signal, or `HANGS`
    out: str
    err: str
    calls: list[str]  # system calls on the folders

    @property
    def document(self) -> Any:
        return without_times(json.loads(self.out))


class Runner:
    """Process that runs commands, with a folder for cached programs and one for its own files."""

    def __init__(self, cache: Path, scratch: Path) -> None:
        self.cache, self.scratch = cache, scratch
        library = scratch / "faults.so"
        options = ["-std=gnu11", "-O1", "-shared", "-fPIC", HERE / "faults.c", "-o", library, "-ldl"]
        subprocess.run([COMPILER, *options], check=True, timeout=60)
        path = os.pathsep.join([str(HERE.parent), str(HERE)])
        environment = {
            **os.environ,
            "PYTHONPATH": path,
            "JAXHIL_CACHE": str(cache),
            "LD_PRELOAD": str(library),
        }
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def run(self, *arguments: Any, folders: tuple[Path, ...] = (), at: int = -1, kill: bool = False) -> Ran:
        """Run `jaxhil ARGUMENTS`; system call number `at` on the folders fails, or kills the process."""
        assert self._process.stdin and self._process.stdout
        job = {
            "arguments": [str(argument) for argument in arguments],
            "folders": "\n".join(map(str, folders)),
            "at": at,
            "kill": kill,
            "scratch": str(self.scratch),
        }
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        code = json.loads(self._process.stdout.readline())
        out, err, calls = ((self.scratch / name).read_text() for name in ("out", "err", "calls"))
        return Ran(code, out, err, calls.splitlines())

    def close(self) -> None:
        """End the process."""
        self._process.communicate(timeout=60)


def without_times(value: Any) -> Any:
    """Return a document without timings and dates."""
    if isinstance(value, dict):
        times = {"timings", "created", "scenarios_per_second"}
        # The digest of a verdict also depends on the times in it.
        times |= {"sha256"} if "sweep_sha256" in value else set()
        return {key: without_times(one) for key, one in value.items() if key not in times}
    return [without_times(one) for one in value] if isinstance(value, list) else value


def serve() -> None:
    """Read jobs from standard input, and write the result of each job."""
    from jaxhil.simulation.jax_environment import prepare_jax

    prepare_jax()
    import jax
    import matplotlib.backends.backend_agg  # noqa: F401
    import pyarrow.parquet  # noqa: F401

    import tuning.api.sweep
    import tuning.bundle.bundle
    import tuning.cli.parser
    import tuning.gains.tune_all
    import tuning.plots.sweep
    import tuning.plots.tuning_results
    import tuning.sweeps.replay
    import tuning.sweeps.stored_studies
    import tuning.watchdog.calibration  # noqa: F401

    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    for line in sys.stdin:
        job = json.loads(line)
        process = os.fork()
        if process == 0:
            _command(job)
        print(json.dumps(_ended(process)), flush=True)


def _command(job: dict[str, Any]) -> None:
    from tuning.__main__ import main

    scratch = Path(job["scratch"])
    for name, stream in (("out", sys.stdout), ("err", sys.stderr)):
        stream.flush()
        os.dup2(os.open(scratch / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), stream.fileno())
    log = os.fsencode(scratch / "calls")
    ctypes.CDLL(None).faults_arm(
        job["folders"].encode(), ctypes.c_long(job["at"]), ctypes.c_int(job["kill"]), log
    )
    try:
        code = main(job["arguments"])
    except SystemExit as stop:
        code = stop.code
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 99)


def _ended(process: int) -> int | str:
    begun = time.monotonic()
    while time.monotonic() - begun < LONGEST:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(process, 9)
    os.waitpid(process, 0)
    return HANGS


if __name__ == "__main__":
    serve()
