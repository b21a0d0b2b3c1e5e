"""Environment variables and standard streams with which a command starts, or fails in one line."""

import json
import os
import subprocess
import sys

import pytest

from jaxhil import InputError
from jaxhil.simulation import jax_environment, jax_startup
from tuning import terminal

pytestmark = pytest.mark.users_options

COMMAND = [sys.executable, "-m", "tuning"]
ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
DEBUGGING = {
    **{
        "JAX_DISABLE_JIT": "1",
        "JAX_DEBUG_NANS": "1",
        "JAX_ENABLE_X64": "0",
        "JAX_TRANSFER_GUARD": "disallow",
    },
    **{
        "MPLBACKEND": "none-such",
        "PYTHONWARNINGS": "error",
        "COLUMNS": "1",
        "TERM": "dumb",
        "HOME": "/nonexistent",
    },
}


def run(*arguments, shell=None, **variables):
    """Run a command in a separate process; `shell` is appended to its command line."""
    command = [*COMMAND, *arguments]
    if shell is not None:
        command = ["bash", "-c", f'"$@" {shell}', "bash", *command]
    places = os.pathsep.join([ROOT, os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        command, env={**os.environ, "PYTHONPATH": places, **variables}, capture_output=True, text=True,
        timeout=300, check=False,
    )  # fmt: skip


def refused(ran, *words):
    assert ran.returncode == 2 and ran.stderr.count("\n") == 1 and "internal error" not in ran.stderr, ran
    for word in words:
        assert word in ran.stderr


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"XLA_FLAGS": "--xla_nonsense=1"}, ["XLA_FLAGS: found '--xla_nonsense=1'", "Unknown flag"]),
        ({"XLA_FLAGS": "no-file"}, ["XLA_FLAGS: found 'no-file'", "a file of flags"]),
        ({"JAX_PLATFORMS": "none-such"}, ["JAX_PLATFORMS=none-such"]),
        ({"JAX_ENABLE_X64": "perhaps"}, ["JAX_ENABLE_X64=perhaps"]),
    ],
)
def test_environment_variables_that_prevent_start_of_jax_are_rejected(variables, words):
    ran = run("simulate", "rig-300kg", "--json", **variables)
    refused(ran, *words)
    assert json.loads(ran.stdout)["schema"] == "jaxhil/error/1"


def test_xla_flags_that_abort_the_process_raise_python_error():
    script = "import jaxhil; jaxhil.simulate('rig-300kg')"
    variables = {**os.environ, "PYTHONPATH": ROOT, "XLA_FLAGS": "--xla_nonsense=1"}
    ran = subprocess.run(
        [sys.executable, "-c", script], env=variables,
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert "InputError: XLA_FLAGS: found '--xla_nonsense=1'" in ran.stderr


@pytest.mark.slow
def test_jax_debugging_modes_change_no_result(jaxhil, tmp_path):
    ran = run("simulate", "rig-300kg", "--json", "--plot", str(tmp_path / "run.png"), **DEBUGGING)
    assert ran.returncode == 1, ran.stderr
    assert json.loads(ran.stdout) == jaxhil("simulate", "rig-300kg", "--json").document
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_xla_flags_are_tested_in_a_separate_process():
    jax_startup.check_xla_flags("--xla_cpu_ftz=true")
    for flags, reason in (
        ("--xla_backend_optimization_level=high", "interpret value high"),
        ("--xla_backend_extra_options=-no-such-option", "Unknown command line argument"),
    ):
        with pytest.raises(InputError, match=f"XLA_FLAGS: found '{flags}'.*{reason}"):
            jax_startup.check_xla_flags(flags)


def test_xla_flags_are_read_from_flag_file(tmp_path):
    (tmp_path / "flags").write_text("--xla_cpu_ftz=true\n--xla_backend_optimization_level=3\n")
    flags = "--xla_cpu_ftz=true --xla_backend_optimization_level=3"
    assert jax_environment.build_xla_flags(str(tmp_path / "flags")) == jax_environment.build_xla_flags(flags)


def test_fork_of_process_with_running_jax_is_rejected(monkeypatch):
    monkeypatch.setattr(jax_startup, "_processes", set())
    jax_startup.check_not_forked()
    jax_startup.check_not_forked()
    monkeypatch.setattr(os, "getpid", lambda: -1)
    with pytest.raises(InputError, match="a process forked after the start of JAX, expected a spawned one"):
        jax_startup.check_not_forked()


def test_closed_standard_output_is_rejected_before_any_work():
    refused(run("simulate", shell=">&-"), "standard output: found a closed stream")


def test_write_failure_of_standard_output_on_full_device_is_reported_in_one_line():
    refused(run("mechanisms", "--json", shell="> /dev/full"), "standard output: cannot be written: No space")


@pytest.mark.slow
@pytest.mark.parametrize(
    "shell",
    ["2>&- <&-", "2> /dev/full", "2> >(true)"],
)
def test_command_result_is_unchanged_if_standard_error_is_closed(jaxhil, tmp_path, shell):
    arguments = "simulate", "rig-300kg", "--json", "--log", str(tmp_path / "log.csv")
    ran = run(*arguments, shell=shell)
    assert (ran.returncode, ran.stderr) == (1, "")
    assert json.loads(ran.stdout) == jaxhil(*arguments).document


def test_closed_output_pipe_causes_no_error(tmp_path):
    ran = run(
        "simulate", "rig-300kg", "--log", str(tmp_path / "log.csv"), shell="| true; exit ${PIPESTATUS[0]}"
    )
    assert ran.returncode == 1 and "wrote" in ran.stderr and (tmp_path / "log.csv").exists()
    ran = run("--help", shell="| true; exit ${PIPESTATUS[0]}")
    assert (ran.returncode, ran.stderr) == (0, "")


def test_command_result_is_printed_if_progress_notes_cannot_be_written(monkeypatch, capsys):
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as broken:
        monkeypatch.setattr(sys, "stderr", broken)
        terminal.note("on the way")
        terminal.emit_line("the result")
    assert capsys.readouterr().out == "the result\n"
