"""Protection of files: commands replace only files that they have written, and never links or pipes."""

import json
import os

import pytest
from sweep_cases import case

from jaxhil.mechanism.file import builtin_path
from tuning.gain_file import write_gain_file

COMPARE = (
    "compare",
    "rig-300kg",
    "--untuned",
    "--compensators",
    "none",
    "--scenarios",
    "1",
    "--evaluated",
    "2",
)


@pytest.fixture
def thesis(tmp_path):
    """Return a folder with files of the user."""
    folder = tmp_path / "thesis"
    folder.mkdir()
    for name in (".thesis.docx.tmp", ".thesis.docx.1.tmp", "errors.png", "loss.png", ".lock"):
        (folder / name).write_text("years")
    return folder


@pytest.fixture
def untouched(thesis):
    """Check at the end that all files below the folder are unchanged."""

    def everything():
        files = sorted(thesis.rglob("*"))
        return [(path, os.lstat(path).st_mode, path.is_file() and path.read_bytes()) for path in files]

    before = everything()
    yield
    assert everything() == before


def refused(ran, *words):
    assert ran.code == 2 and ran.err.count("\n") == 1, ran
    for word in words:
        assert word in ran.err


def test_command_results_do_not_replace_third_party_files(jaxhil, thesis, untouched):
    refused(jaxhil(*COMPARE, "-o", thesis), "errors.png: found a file that jaxhil did not write")
    tune = ("tune", "rig-300kg", "-o", thesis.parent, "--set", "name='thesis'")
    refused(jaxhil(*tune), "thesis/errors.png: found a file that jaxhil did not write")


def test_overview_plot_does_not_replace_a_third_party_picture(jaxhil, thesis):
    (thesis / "overview.png").write_text("years")
    names = ("rig-300kg", "varying", "layered", "rattling", "claw-350kg")
    refused(jaxhil("tune", *names, "-o", thesis), "overview.png: found a file that jaxhil did not write")
    assert (thesis / "overview.png").read_text() == "years"


@pytest.mark.parametrize("content", ["{}", "years", "[1]", ""])
def test_third_party_json_document_is_not_replaced(jaxhil, tmp_path, content):
    for name in ("compare.json", "gains.json"):
        (tmp_path / name).write_text(content)
    refused(jaxhil(*COMPARE, "-o", tmp_path), "compare.json: found a file that jaxhil did not write")
    tune = ("tune", "rig-300kg", "-o", tmp_path.parent, "--set", f"name='{tmp_path.name}'")
    refused(jaxhil(*tune), "gains.json: found a file that jaxhil did not write")
    assert [(tmp_path / name).read_text() for name in ("compare.json", "gains.json")] == [content] * 2


def test_sweep_rejects_folder_with_third_party_files(jaxhil, thesis, untouched, tmp_path):
    write_gain_file(tmp_path / "gains.json", case())
    for more in ((), ("--resume",)):
        ran = jaxhil("sweep", tmp_path / "gains.json", "--scenarios", "2", "-o", thesis, *more)
        refused(ran, "thesis: found '.thesis.docx.1.tmp' and no sweep, expected an empty folder, or a sweep")


TUNE = (
    "tune",
    "--compensator",
    "none",
    "--scenarios",
    "4",
    "--starts",
    "2",
    "--steps",
    "2",
    "--evaluated",
    "16",
)


def named(path, name):
    """Write a mechanism file of that name and return its path."""
    raw = builtin_path("rig-300kg").read_text(encoding="utf-8")
    path.write_text(raw.replace('name = "rig-300kg"', f"name = '{name}'"), encoding="utf-8")
    return path


RESULTS = {  # Mechanism "a b": the command that would replace files, the document, its content
    "tune": (("tune",), "a_b/gains.json", {"compensator": "none", "mechanism": {"name": "a b"}}),
    "map": (("map", "--x", "rig.force_sensor.delay", "--y", "contact.stiffness"), "map.json",
            {"theory": {}, "mechanism": "a b"}),
    "compare": (("compare", "--untuned"), "compare.json",
                {"mechanisms": [{"mechanism": "a_b"}, {"mechanism": "a b"}]}),
}  # fmt: skip


@pytest.mark.parametrize("kind", RESULTS)
def test_results_of_another_mechanism_are_not_overwritten(jaxhil, tmp_path, kind):
    (command, *options), document, content = RESULTS[kind]
    path = tmp_path / "out" / document
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content))
    before = path.read_bytes()
    file = named(tmp_path / "rig.toml", "a_b")
    ran = jaxhil(command, file, *options, "-o", tmp_path / "out")
    refused(ran, f"{document}: found results of mechanism 'a b', expected results of 'a_b'")
    assert path.read_bytes() == before


def test_identified_file_of_another_mechanism_is_not_overwritten(jaxhil, tmp_path):
    content = {"estimates": [], "mechanism": {"name": "a b"}}
    (tmp_path / "identification.json").write_text(json.dumps(content))
    ran = jaxhil("identify", "none.csv", "--prior", "rig-300kg", "-o", tmp_path)
    refused(ran, "found results of mechanism 'a b', expected results of 'rig-300kg'")


@pytest.mark.parametrize("names", [("a b", "a_b"), ("Rig", "rig"), ("..", "..."), ("é", "e\u0301")])
def test_mechanisms_tuned_in_one_call_have_separate_folders(jaxhil, tmp_path, names):
    files = [named(tmp_path / f"{path}.toml", name) for path, name in enumerate(names)]
    ran = jaxhil(*TUNE, *files, "-o", tmp_path / "out", "--json")
    assert ran.code == 2 and "1.toml: name: found" in ran.err
    [entry] = ran.document["mechanisms"]
    assert entry["mechanism"] == names[0]


def test_gains_of_different_mechanism_with_same_name_are_replaced_with_warning(jaxhil, tmp_path):
    file = named(tmp_path / "rig.toml", "機構一")
    options = (file, *TUNE[1:], "-o", tmp_path / "out")
    assert "replaced" not in jaxhil(TUNE[0], *options).err
    assert "replaced" not in jaxhil(TUNE[0], *options).err
    ran = jaxhil(TUNE[0], *options, "--set", "bodies.equivalent_mass=301")
    assert (
        "warning: " in ran.err
        and "replaced; it was for a different mechanism with the name '機構一'" in ran.err
    )
    assert (tmp_path / "out" / "機構一" / "gains.json").exists()


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    "command",
    [
        ("simulate",),
        ("simulate", "--gains"),
        ("tune", "rig-300kg", "--start"),
        ("sweep",),
        ("export",),
        ("verify",),
        ("shadow",),
        ("rig",),
        ("identify", "--prior", "rig-300kg"),
        ("identify", "log.csv", "--map"),
        ("monitor", "rig-300kg"),
        ("report",),
    ],
    ids=" ".join,
)
def test_input_from_a_pipe_or_device_is_rejected(jaxhil, tmp_path, monkeypatch, command, kind):
    """Reading would block on a pipe and never end on a device."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("t\n")
    path = tmp_path / "input.csv"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    refused(jaxhil(*command, path), "input.csv", "found a")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_plot_file_replaces_only_a_plain_file(jaxhil, tmp_path, kind):
    path = tmp_path / "plot.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/full")
    before = os.lstat(path).st_ino, os.stat("/dev/full").st_ino
    ran = jaxhil("simulate", "rig-300kg", "--plot", path)
    refused(ran, f"plot.png: cannot be written: found a {kind}, expected a plain file")
    assert (os.lstat(path).st_ino, os.stat("/dev/full").st_ino) == before


def test_output_path_that_is_a_link_writes_to_the_linked_file(jaxhil, tmp_path):
    (tmp_path / "there.png").write_bytes(b"an older picture")
    (tmp_path / "plot.png").symlink_to("there.png")
    ran = jaxhil("simulate", "rig-300kg", "--plot", tmp_path / "plot.png", "--json")
    assert json.loads(ran.out)["mechanism"] == "rig-300kg"
    assert os.readlink(tmp_path / "plot.png") == "there.png"
    assert (tmp_path / "there.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(os.listdir(tmp_path)) == ["plot.png", "there.png"]
