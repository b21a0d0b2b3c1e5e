"""Usage of the command line: error messages, help, interrupts, names of folders."""

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import hypothesis
import hypothesis.strategies
import msgspec
import pytest
from conftest import Ran

import tuning.cli.commands
from jaxhil.mechanism.file import builtin_names, load, six_axis_names, suite_names
from jaxhil.mechanism.json_schema import build_json_schema
from jaxhil.simulation import jax_environment
from tuning.api.sweep_options import DEFAULT_SOBOL_SCENARIOS
from tuning.cli.commands.tune import is_better, make_folder_name
from tuning.cli.options import DEFAULT_PLOT
from tuning.cli.parser import complete_bare_options, replace_old_names
from tuning.gains.tune import ErrorMetrics

ERROR_KEYS = ["schema", "command", "verdict", "problems"]
COMMANDS = Path(tuning.cli.commands.__file__).parent


def refused(ran, *words):
    """Check for exit code 2, no standard output, and one line on standard error with all `words`."""
    assert ran.code == 2
    assert ran.out == ""
    assert ran.err.startswith("jaxhil: ") and ran.err.count("\n") == 1 and ran.err.endswith("\n")
    for word in words:
        assert word in ran.err


def test_cli_exits_with_code_130_on_interrupt(jaxhil, monkeypatch):
    def interrupted(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("tuning.cli.parser.parse", interrupted)
    assert jaxhil("mechanisms") == Ran(130, "", "jaxhil: interrupted\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "nowhere.toml"], ["nowhere.toml", "no such file"]),
        (["simulate", "rig-300"], ["did you mean rig-300kg"]),
        (["simulate", "--set", "approach.velocity=-1"], ["approach.velocity", "-1", "> 0"]),
        (["simulate", "--set", "approach.speed=1"], ["approach.speed", "unknown key"]),
        (["simulate", "--compensator", "magic"], ["magic", "none, dead_zone_observer, impulse_ledger"]),
        (["simulate", "--gains", "nowhere.json"], ["nowhere.json"]),
        (
            ["simulate", "--compensator", "phase_lead", "--setting", "sharp"],
            ["sharp", "none: phase_lead has"],
        ),
        (
            ["simulate", "--gains", "x.json", "--setting", "sharp"],
            ["--setting", "none together with --gains"],
        ),
        (["tune", "--setting", "sharp"], ["--setting", "sharp", "none: response_error has"]),
        (["simulate", "--limit", "nan"], ["--limit"]),
        (["simulate", "--plot=plot.doc"], ["--plot", "plot.doc", ".png"]),
        (["simulate", "--seed", "-1"], ["--seed", "-1"]),
        (["tune", "--starts", "0"], ["--starts", ">= 1"]),
        (["tune", "--compensator", "magic"], ["magic", "response_error"]),
        (["verify", "nowhere.json"], ["nowhere.json", "No such file"]),
        (["verify", "x", "--scenarios", "0"], ["--scenarios"]),
        (["init", "rig-300"], ["rig-300", "did you mean rig-300kg"]),
        (["init", "a.toml", "-o", "b.toml"], ["--output", "'b.toml' and a.toml", "only one file"]),
    ],
)
def test_cli_reports_unusable_input_with_one_line_message(jaxhil, arguments, words):
    refused(jaxhil(*arguments), *words)


@pytest.mark.parametrize(
    "words",
    [
        "init nowhere",
        "simulate nowhere.toml",
        "identify nowhere.csv",
        "identify --guess nowhere.csv",
        "identify --design nowhere.toml",
        "identify --check nowhere.csv nowhere.toml",
        "monitor nowhere.toml nowhere.csv",
        "tune nowhere.toml",
        "sweep nowhere.json",
        "replay nowhere 3",
        "export nowhere.json",
        "shadow nowhere.json nowhere.csv",
        "verify nowhere.json",
        "rig nowhere.json",
        "compare nowhere.toml",
        "map nowhere.toml --x a --y b",
        "report nowhere",
        "mechanisms --nowhere",
    ],
)
def test_error_documents_of_all_commands_have_the_same_form(jaxhil, monkeypatch, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    ran = jaxhil(*words.split(), "--json")
    document = ran.document
    assert ran.code == 2 and document["schema"] == "jaxhil/error/1"
    assert document["command"] == words.split()[0] and list(document) == ERROR_KEYS
    (problem,) = document["problems"]
    assert ran.err == f"jaxhil: {problem}\n" or problem.startswith("wrong arguments")


def test_error_document_test_covers_every_command():
    marks = test_error_documents_of_all_commands_have_the_same_form.pytestmark
    tested = {words.split()[0] for words in marks[0].args[1]}
    modules = [path for path in COMMANDS.glob("*.py") if "_" not in path.stem]
    assert tested == {path.stem for path in modules if "\ndef run(options" in path.read_text()}


def test_identify_reports_missing_log_before_missing_values(jaxhil):
    refused(jaxhil("identify", "nowhere.csv"), "nowhere.csv: found no such file, expected a log")


def test_simulate_reports_plot_that_cannot_be_written(jaxhil, tmp_path):
    (tmp_path / "taken").touch()
    ran = jaxhil("simulate", "rig-300kg", "--plot", tmp_path / "taken" / "plot.png")
    refused(ran, "taken")


def test_tune_reports_output_folder_that_cannot_be_created(jaxhil, tmp_path):
    (tmp_path / "taken").touch()
    refused(jaxhil("tune", "rig-300kg", "-o", tmp_path / "taken"), "taken")


def test_cli_reports_internal_error_with_one_line_message(jaxhil, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("inside")

    monkeypatch.setattr("tuning.cli.commands.mechanisms.load", broken)
    refused(jaxhil("mechanisms"), "internal error", "ZeroDivisionError: inside")


@pytest.mark.parametrize("arguments", [["--no-such"], ["fly"], [], ["tune", "--starts", "x"], ["verify"]])
def test_cli_exits_with_code_2_on_wrong_usage(jaxhil, arguments):
    ran = jaxhil(*arguments)
    assert ran.code == 2 and ran.out == "" and ran.err != ""


@pytest.mark.parametrize(
    "command", ["init", "simulate", "tune", "export", "verify", "shadow", "rig", "mechanisms"]
)
def test_cli_help_shows_an_example(jaxhil, command):
    ran = jaxhil(command, "--help")
    assert ran.code == 0
    assert f"Example: jaxhil {command}" in " ".join(ran.out.split())
    assert "--json" in ran.out


def test_cli_help_and_usage_errors_do_not_import_jax():
    program = (
        "import sys\nfrom tuning.__main__ import main\n"
        "for words in (['tune', '--help'], ['mechanisms'], ['tune', '--compensator', 'x'], ['tune', 'x'],\n"
        "    ['export', 'x', '--format', 'y'], ['export', 'x']):\n"
        "    try: main(words)\n"
        "    except SystemExit: pass\n"
        "assert not {'jax', 'matplotlib'} & set(sys.modules), 'slow imports'"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_python_module_runs_as_command_and_tolerates_closed_pipe():
    command = [sys.executable, "-m", "tuning", "mechanisms"]
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


def test_mechanisms_command_lists_builtin_files(jaxhil):
    document = jaxhil("mechanisms", "--json").document
    entries = document["mechanisms"]
    assert [entry["name"] for entry in entries] == builtin_names()
    assert [entry["name"] for entry in document["suites"]] == suite_names()
    assert all(entry["source"] for entry in entries)
    rig = next(entry for entry in entries if entry["name"] == "rig-300kg")
    assert rig["contact_frequencies"] == [pytest.approx(3.0, rel=1e-5)]
    listed = jaxhil("mechanisms").out
    assert all(entry["source"][:20] in listed for entry in [*entries, *document["suites"]])
    assert str(Path(rig["path"]).parent) in "".join(listed.split("\n"))
    assert jaxhil("mechanisms", "--schema").document == build_json_schema()


@pytest.mark.parametrize(
    ("arguments", "written", "source"),
    [
        ([], "mechanism.toml", "varying"),
        (["my-rig.toml"], "my-rig.toml", "varying"),
        (["suite-hertz", "-o", "study/my rig.toml"], "study/my rig.toml", "suite-hertz"),
    ],
)
def test_init_command_writes_mechanism_file(jaxhil, monkeypatch, tmp_path, arguments, written, source):
    monkeypatch.chdir(tmp_path)
    ran = jaxhil("init", *arguments, "--json")
    assert ran.code == 0
    mechanism = load(written).mechanism
    assert mechanism.name == ran.document["name"] == Path(written).stem
    builtin = load(source).mechanism
    assert msgspec.structs.replace(mechanism, name=source, source=builtin.source) == builtin
    assert mechanism.source.startswith(f"the values of the built-in {source}, until you replace them")
    assert [path.name for path in (tmp_path / written).parent.iterdir()] == [Path(written).name]


@pytest.mark.parametrize("taken", [Path.touch, Path.mkdir, lambda path: path.symlink_to("nowhere")])
def test_init_command_never_overwrites_a_file(jaxhil, tmp_path, taken):
    path = tmp_path / "rig.toml"
    taken(path)
    before = os.lstat(path)
    refused(jaxhil("init", "-o", path), str(path), "no file is overwritten")
    assert os.lstat(path) == before and list(tmp_path.iterdir()) == [path]


def test_init_command_lists_names_of_builtin_mechanisms(jaxhil):
    names = [*builtin_names(), *suite_names(), *six_axis_names()]
    assert (
        jaxhil("init", "--list").out.split() == jaxhil("init", "--list", "--json").document["names"] == names
    )


def test_cli_prints_version_and_shell_completion(jaxhil):
    assert jaxhil("--version") == Ran(0, f"jaxhil {metadata.version('jaxhil')}\n", "")
    assert "--tyro-write-completion bash" in " ".join(jaxhil("--help").out.split())
    assert "jaxhil" in jaxhil("--tyro-print-completion", "bash").out


def test_plot_option_without_value_uses_default_file_name():
    assert complete_bare_options(["simulate", "--plot", "a.png", "x"]) == ["simulate", "--plot", "a.png", "x"]
    assert complete_bare_options(["--plot", "--json"]) == ["--plot", DEFAULT_PLOT, "--json"]
    assert complete_bare_options(["x", "--plot"]) == ["x", "--plot", DEFAULT_PLOT]


def test_sweep_study_options_without_value_use_default_numbers():
    assert complete_bare_options(["--drivers", "64", "--rare", "0.02"]) == [
        "--drivers",
        "64",
        "--rare",
        "0.02",
    ]
    assert complete_bare_options(["--rare", "gains.json"]) == ["--rare", "0", "gains.json"]
    assert complete_bare_options(["--drivers", "--rare"]) == [
        "--drivers",
        str(DEFAULT_SOBOL_SCENARIOS),
        "--rare",
        "0",
    ]


def test_folder_name_keeps_unicode_and_replaces_unsafe_names():
    assert make_folder_name("rig-300kg") == "rig-300kg"
    assert make_folder_name("../a b/c") == "a_b_c"
    assert make_folder_name("..") == "mechanism"
    for name in ("機構一", "стенд-2", "שלום", "हिन्दी", "é"):
        assert make_folder_name(name) == name
    assert make_folder_name("e\u0301") == "é"
    assert make_folder_name("CON") != "CON" and make_folder_name("com1.rig") != "com1.rig"
    long = [make_folder_name("機" * 90 + end) for end in "ab"]
    assert long[0] != long[1] and all(len(name.encode()) <= 120 for name in long)


@hypothesis.given(hypothesis.strategies.text(min_size=1, max_size=100).filter(str.isprintable))
def test_folder_name_is_a_single_safe_path_component(name):
    folder = make_folder_name(name)
    assert folder not in ("", ".", "..") and "/" not in folder and folder.isprintable()
    assert len(folder.encode()) <= 120 and not folder.startswith(".")


def test_results_are_ranked_by_number_of_failures_before_error():
    def made(rms, failed):
        return ErrorMetrics(rms, rms, rms, rms, 0.0, 1.0, 0.0, failed)

    assert is_better(made(0.1, 0), made(0.2, 0)) and not is_better(made(0.2, 0), made(0.1, 0))
    assert is_better(made(0.2, 0), made(0.1, 1)) and not is_better(made(float("nan"), 0), made(0.1, 0))


def test_xla_flags_of_user_take_precedence(monkeypatch):
    names = [flag.split("=")[0] for flag in jax_environment.build_xla_flags("").split()]
    assert names == [
        "--xla_force_host_platform_device_count",
        "--xla_backend_optimization_level",
        "--xla_backend_extra_options",
    ]
    user_flags = "--xla_backend_optimization_level=3 --xla_dump_to=x"
    assert jax_environment.build_xla_flags(user_flags).startswith(user_flags)
    assert jax_environment.build_xla_flags(user_flags).count("optimization_level") == 1


def test_cache_folder_is_none_if_folder_cannot_be_created(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("JAXHIL_CACHE", str(tmp_path / "file" / "below"))
    assert jax_environment.cache_folder() is None
    monkeypatch.setenv("JAXHIL_CACHE", str(tmp_path / "new"))
    assert jax_environment.cache_folder() == tmp_path / "new"
    assert (tmp_path / "new").is_dir()


def test_old_names_of_options_are_replaced_with_a_warning(capsys):
    old = ["tune", "--validation=8", "--pareto-against", "honesty", "--certify", "honesty"]
    new = ["tune", "--evaluated=8", "--pareto-against", "transparency", "--global-search", "honesty"]
    assert replace_old_names(old) == new
    assert capsys.readouterr().err.count("warning: ") == 3
    assert replace_old_names(new) == new and capsys.readouterr().err == ""
