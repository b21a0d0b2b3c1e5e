"""Command `jaxhil identify`: from log files of an independent simulator to mechanism file and exit code."""

import json
import re

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
    """Disable plots, which have separate tests."""
    monkeypatch.setattr("tuning.plots.identification.draw_identification", lambda *_: {})


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """Return the logs of a rig without defects."""
    folder = tmp_path_factory.mktemp("day")
    write(folder, campaigns.campaign("clean", 0, speeds=FEW, seconds=30.0))
    return folder


def drafted(jaxhil, folder):
    """Draft a mapping and add the mass, which only the user knows."""
    ran = jaxhil("identify", "--guess", *logs(folder))
    assert ran.code == 0 and ran.err == ""
    path = folder / "map.toml"
    path.write_text(ran.out.replace("# [bodies]", "[bodies]").replace("# equivalent_mass", "equivalent_mass"))
    return path


def test_identify_command_writes_mechanism_file_from_logs(jaxhil, day, tmp_path):
    command = ("identify", *logs(day), "--map", drafted(jaxhil, day), "--law", "kelvin_voigt", "-o", tmp_path)
    ran = jaxhil(*command, "--json")
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
    (delay,) = (item for item in ran.document["estimates"] if item["key"] == "rig.force_sensor.delay")
    assert delay["low"] < 0.0037 < delay["high"] and delay["unit"] == "s" and delay["prior"] is None

    # Without a prior all mechanisms have the same name; logs of another rig must not overwrite the results.
    (tmp_path / "other").mkdir()
    write(tmp_path / "other", campaigns.campaign("clean", 1, speeds=FEW[:3], seconds=5.0))
    refused = jaxhil("identify", *logs(tmp_path / "other"), *command[-6:])
    assert refused.code == 2 and "found results of other logs ('contact_02.csv' and " in refused.err
    assert ran.document == json.loads((tmp_path / "identification.json").read_text())

    # The file explains its own logs; a file of another rig does not.
    mechanism_file, map = tmp_path / "mechanism.toml", ("--map", drafted(jaxhil, day))
    ran = jaxhil("identify", "--check", *logs(day), mechanism_file, *map)
    assert ran.code == 0 and "What identified does not explain in runs: 9 contact, 1 free, 1 rest" in ran.out
    mechanism_file.write_text(mechanism_file.read_text().replace("stiffness = [1", "stiffness = [2"))
    ran = jaxhil("identify", "--check", *logs(day), *map, "--prior", mechanism_file, "--json")
    assert ran.code == 1 and ran.document["estimates"] == [] and "contact law" in ran.document["reason"]

    # A file that this program did not write is not overwritten.
    (tmp_path / "identification.json").unlink()
    refused = jaxhil(*command)
    assert refused.code == 2 and "mechanism.toml: found a file that jaxhil did not write" in refused.err


@pytest.mark.parametrize("mass", [300.0, pytest.param(12.0, marks=pytest.mark.slow)])
def test_every_contact_of_a_diverging_simulated_log_is_a_run(tmp_path, mass):
    contacts = {"approach.contacts": 5, "approach.velocity": 0.003}
    bodies = {"bodies.equivalent_mass": mass, "contact.stiffness": [mass * (2.0 * np.pi * 3.0) ** 2]}
    mechanism = package.load("rig-300kg", {**contacts, **bodies})
    run = package.simulate(mechanism, "none")
    run.to_csv(tmp_path / "run.csv")
    exact = read_campaign([tmp_path / "run.csv"], None, mechanism)
    velocities = [contact.approach_velocity for contact in run.contacts]
    assert velocities[-1] > 5.0 * velocities[0]
    assert [logged.speed for logged in exact.runs] == pytest.approx(velocities, rel=1e-3)
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    table["position_desired"] = table["position_desired"].round(5)
    rounded, heading = tmp_path / "rounded.csv", ",".join(table.dtype.names)
    np.savetxt(rounded, table, delimiter=",", header=heading, comments="")
    assert len(read_campaign([rounded], None, mechanism).runs) == 5


def test_identify_command_verdict_is_bad_for_wrong_mapping_file(jaxhil, day, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    path = tmp_path / "map.toml"
    path.write_text(drafted(jaxhil, day).read_text().replace('"linear"', '"zoh"'))
    command = (
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
    ran = jaxhil(*command)
    assert ran.code == 1
    assert "Bad: the model does not explain this rig: command hold" in " ".join(ran.out.split())
    assert [line for line in ran.out.splitlines() if len(line) > 80 and not line.startswith("Next: ")] == []
    assert re.search(r"prior +\[%\]", ran.out)
    assert re.search(r"contact.stiffness\[0\] .* [+-][\d.]+ *$", ran.out, re.M)
    head = (tmp_path / "mechanism.toml").read_text().splitlines()[:3]
    assert head[0].startswith("# Bad: ") and head[1].startswith(
        "# [uncertainty] is the uncertainty of the estimate"
    )


def test_identify_command_writes_nothing_without_contact_and_prior(jaxhil, day, tmp_path):
    free = [path for path in logs(day) if path.name.startswith("free")]
    ran = jaxhil("identify", *free, "--map", drafted(jaxhil, day), "-o", tmp_path)
    assert ran.code == 1 and not list(tmp_path.iterdir())
    assert "logs and prior do not determine contact.stiffness" in " ".join(ran.out.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["logs: found none"]),
        (["--guess"], ["logs: found none"]),
        (["LOGS"], ["': found no column with this name", "--guess writes a draft of it"]),
        (["LOGS", "--map", "none.toml"], ["none.toml: found no such file"]),
        (["LOGS", "--prior", "rig-300"], ["did you mean rig-300kg"]),
        (["LOGS", "--hold-out", "1"], ["--hold-out: found 1.0"]),
        (["LOGS", "--fix", "rig.contact_plane"], ["--fix rig.contact_plane"]),
        (["LOGS", "--fix", "rig.contact_plane=a"], ["contact_plane=a: found 'a', expected a number"]),
        (["LOGS", "--fix", "contact.damping=[650, nan]"], ["found [650, nan], expected a number or a list"]),
        (["--check", "LOG"], ["--check: found no mechanism"]),
        (["--check", "LOG", "rig-300"], ["did you mean rig-300kg"]),
        (["--check", "LOG", "rig-300kg", "--law", "linear"], ["--law: found together with --check"]),
        (["--design"], ["--design: found 0 mechanisms"]),
        (["--design", "rig-300"], ["did you mean rig-300kg"]),
        (["--design", "rig-300kg", "--stroke", "0"], ["--stroke: found 0 m, expected a number > 0"]),
        (["LOGS", "--bayes"], ["--bayes: found no prior"]),
        (["LOGS", "--limit", "nan"], ["--limit"]),
        (["LOGS", "--order", "ten"], ["--order: found 'ten', expected auto, or 0 to 4"]),
        (["LOGS", "--map", "MAP", "--stage", "press"], ["--stage: found 'press'", "contact, free"]),
    ],
)  # fmt: skip
def test_identify_rejects_bad_arguments_with_one_line_message(jaxhil, day, tmp_path, arguments, words):
    words_for = {
        "LOGS": logs(day),
        "LOG": logs(day)[:1],
        "MAP": [drafted(jaxhil, day)] if "MAP" in arguments else [],
    }
    words_given = [value for word in arguments for value in words_for.get(word, [word])]
    modes = {"--prior", "--guess", "--check", "--bayes", "--design"} & {*arguments}
    prior = [] if modes else ["--prior", "rig-300kg"]
    ran = jaxhil("identify", *words_given, *prior, "-o", tmp_path)
    assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1
    assert all(word in ran.err for word in words)


KINDS = ["jitter", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("noisy", "stiffnesses"))]


@pytest.mark.parametrize("kind", KINDS)
def test_signals_of_independent_rig_are_recovered_from_its_logs(jaxhil, kind, tmp_path):
    campaign = campaigns.campaign(kind, 1, speeds=FEW, seconds=20.0)
    write(tmp_path, campaign, campaigns.KINDS[kind].jitter)
    recovered = read_campaign(logs(tmp_path), load_mapping(drafted(jaxhil, tmp_path)))
    for run in campaign.runs:
        name = f"{run.kind}_{campaign.runs.index(run):02}.csv"
        parts = [part for part in recovered.runs if part.source == name]
        # The first row has tick 0; the first rows are never lost.
        ticks = np.concatenate([part.tick for part in parts])
        valid = np.concatenate([part.valid for part in parts])
        np.testing.assert_array_equal(ticks[valid], run.tick[run.valid])
        for channel in ("position_desired", "position_measured", "force_measured"):
            values = np.concatenate([getattr(part, channel) for part in parts])
            np.testing.assert_allclose(
                values[valid], getattr(run, channel)[run.valid], rtol=1e-12, atol=1e-15
            )
        back = np.concatenate([part.position_desired for part in parts])
        # A cubic reproduces the multisine to 0.1 %; the model reproduces the command of a contact.
        error = np.max(np.abs(back - run.position_desired[ticks]))
        assert error < (1e-10 if run.kind == "contact" else 5e-6)
