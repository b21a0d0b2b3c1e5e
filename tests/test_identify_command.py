"""`jaxhil identify`: from log files of an independent rig to a mechanism file and an exit code."""

import json

import campaigns
import numpy as np
import pytest
from campaign_logs import logs, write

import jaxhil as package
from jaxhil.rig import digest
from tuning.identification.logs.campaign import read_campaign
from tuning.identification.logs.mapping import load_mapping

FEW = (0.003, 0.006, 0.012) * 3


@pytest.fixture(autouse=True)
def _undrawn(monkeypatch):
    """Pictures have tests of their own."""
    monkeypatch.setattr("tuning.identification.pictures.draw", lambda *_: {})


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """Logs of a clean rig."""
    folder = tmp_path_factory.mktemp("day")
    write(folder, campaigns.campaign("clean", 0, speeds=FEW, seconds=30.0))
    return folder


def drafted(jaxhil, folder):
    """The drafted mapping, with the mass that only its user knows."""
    ran = jaxhil("identify", "--guess", *logs(folder))
    assert ran.code == 0 and ran.err == ""
    path = folder / "map.toml"
    path.write_text(ran.out.replace("# [bodies]", "[bodies]").replace("# equivalent_mass", "equivalent_mass"))
    return path


def test_a_day_of_logs_becomes_a_mechanism_file(jaxhil, day, tmp_path):
    given = ("identify", *logs(day), "--map", drafted(jaxhil, day), "--law", "kelvin_voigt", "-o", tmp_path)
    ran = jaxhil(*given, "--json")
    assert ran.code == 0 and ran.document["verdict"] == "good"
    assert ran.document == json.loads((tmp_path / "identification.json").read_text())
    assert digest(ran.document) == ran.document["sha256"]
    assert ran.document["runs"] == {"contact": 9, "free": 1, "rest": 1}
    assert ran.document["sources"].keys() == {path.name for path in logs(day)}
    mechanism = package.load(tmp_path / "mechanism.toml")
    assert mechanism.rig.simulator.natural_frequency == pytest.approx(12.0, rel=0.003)
    assert mechanism.rig.force_sensor.delay == pytest.approx(0.0037, abs=2.5e-4)
    assert mechanism.contact.stiffness == [pytest.approx(1.2e5, rel=0.003)]
    assert "rig.force_sensor.delay" in mechanism.correlation.keys
    (delay,) = (one for one in ran.document["estimates"] if one["key"] == "rig.force_sensor.delay")
    assert delay["low"] < 0.0037 < delay["high"] and delay["unit"] == "s" and delay["prior"] is None

    # Without a prior all mechanisms have one name, and logs of another rig must not replace what was written.
    (tmp_path / "other").mkdir()
    write(tmp_path / "other", campaigns.campaign("clean", 1, speeds=FEW[:3], seconds=5.0))
    refused = jaxhil("identify", *logs(tmp_path / "other"), *given[-6:])
    assert refused.code == 2 and "found results of other logs ('contact_02.csv' and " in refused.err
    assert ran.document == json.loads((tmp_path / "identification.json").read_text())

    # The file explains its own logs, and one of another rig does not.
    told, map = tmp_path / "mechanism.toml", ("--map", drafted(jaxhil, day))
    ran = jaxhil("identify", "--check", *logs(day), told, *map)
    assert ran.code == 0 and "What identified leaves of runs: 9 contact, 1 free, 1 rest" in ran.out
    told.write_text(told.read_text().replace("stiffness = [1", "stiffness = [2"))
    ran = jaxhil("identify", "--check", *logs(day), *map, "--prior", told, "--json")
    assert ran.code == 1 and ran.document["estimates"] == [] and "contact law" in ran.document["reason"]

    # What is not ours is not written over.
    (tmp_path / "identification.json").unlink()
    refused = jaxhil(*given)
    assert refused.code == 2 and "mechanism.toml: found a file of something else" in refused.err


def test_what_is_told_wrongly_is_a_bad_verdict(jaxhil, day, tmp_path):
    path = tmp_path / "map.toml"
    path.write_text(drafted(jaxhil, day).read_text().replace('"linear"', '"zoh"'))
    given = (
        "identify",
        *logs(day),
        "--map",
        path,
        "--law",
        "kelvin_voigt",
        "--prior",
        "rig-300kg",
        "-o",
        tmp_path,
    )
    ran = jaxhil(*given)
    assert ran.code == 1
    assert "Bad: the model does not explain this rig: command hold" in ran.out
    assert "off the prior" in ran.out and (tmp_path / "mechanism.toml").exists()


def test_nothing_is_written_where_neither_logs_nor_prior_tell_what_a_file_must_have(jaxhil, day, tmp_path):
    free = [path for path in logs(day) if path.name.startswith("free")]
    ran = jaxhil("identify", *free, "--map", drafted(jaxhil, day), "-o", tmp_path)
    assert ran.code == 1 and not list(tmp_path.iterdir())
    assert "neither the logs nor a prior tell contact.stiffness" in " ".join(ran.out.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["logs: found none"]),
        (["--guess"], ["logs: found none"]),
        (["LOGS"], ["': found none of this name", "--guess drafts one"]),
        (["LOGS", "--map", "none.toml"], ["none.toml: found no such file"]),
        (["LOGS", "--prior", "rig-300"], ["did you mean rig-300kg"]),
        (["LOGS", "--hold-out", "1"], ["--hold-out: found 1.0"]),
        (["LOGS", "--fix", "rig.contact_plane"], ["--fix rig.contact_plane"]),
        (["LOGS", "--fix", "rig.contact_plane=a"], ["contact_plane=a: found 'a', allowed a number"]),
        (["LOGS", "--fix", "contact.damping=[650, nan]"], ["found [650, nan], allowed a number, or a list"]),
        (["--check", "LOG"], ["--check: found no mechanism"]),
        (["--check", "LOG", "rig-300"], ["did you mean rig-300kg"]),
        (["--check", "LOG", "rig-300kg", "--law", "linear"], ["--check: found --law beside it"]),
        (["--design"], ["--design: found 0 mechanisms"]),
        (["--design", "rig-300"], ["did you mean rig-300kg"]),
        (["--design", "rig-300kg", "--stroke", "0"], ["--stroke: found 0 m, allowed a number > 0"]),
        (["LOGS", "--bayes"], ["--bayes: found no prior"]),
        (["LOGS", "--limit", "nan"], ["--limit"]),
        (["LOGS", "--order", "ten"], ["--order: found 'ten', allowed auto, or 0 to 4"]),
        (["LOGS", "--map", "MAP", "--stage", "press"], ["--stage: found 'press'", "contact, free"]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(jaxhil, day, tmp_path, arguments, words):
    words_for = {
        "LOGS": logs(day),
        "LOG": logs(day)[:1],
        "MAP": [drafted(jaxhil, day)] if "MAP" in arguments else [],
    }
    given = [one for word in arguments for one in words_for.get(word, [word])]
    own = {"--prior", "--guess", "--check", "--bayes", "--design"} & {*arguments}
    prior = [] if own else ["--prior", "rig-300kg"]
    ran = jaxhil("identify", *given, *prior, "-o", tmp_path)
    assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1
    assert all(word in ran.err for word in words)


KINDS = ["jitter", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("noisy", "stiffnesses"))]


@pytest.mark.parametrize("kind", KINDS)
def test_logs_give_back_what_an_independent_rig_did(jaxhil, kind, tmp_path):
    """Ticks, commands and readings, whatever the stamps scatter and whichever rows were lost."""
    campaign = campaigns.campaign(kind, 1, speeds=FEW, seconds=20.0)
    write(tmp_path, campaign, campaigns.KINDS[kind].jitter)
    found = read_campaign(logs(tmp_path), load_mapping(drafted(jaxhil, tmp_path)))
    for run in campaign.runs:
        name = f"{run.kind}_{campaign.runs.index(run):02}.csv"
        parts = [one for one in found.runs if one.source == name]
        # The first row's tick is called 0; the first rows are never lost.
        ticks = np.concatenate([one.tick for one in parts])
        valid = np.concatenate([one.valid for one in parts])
        np.testing.assert_array_equal(ticks[valid], run.tick[run.valid])
        for channel in ("position_desired", "position_measured", "force_measured"):
            values = np.concatenate([getattr(one, channel) for one in parts])
            np.testing.assert_allclose(
                values[valid], getattr(run, channel)[run.valid], rtol=1e-12, atol=1e-15
            )
        back = np.concatenate([one.position_desired for one in parts])
        # A cubic tells the multisine to a thousandth of its size; the model tells a contact's command.
        error = np.max(np.abs(back - run.position_desired[ticks]))
        assert error < (1e-10 if run.kind == "contact" else 5e-6)
