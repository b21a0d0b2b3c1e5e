"""Corrupted logs of a good rig: rejected in one line, bad verdict, or identified correctly."""

import campaign_rigs
import campaigns
import numpy as np
import pytest
from campaign_logs import MAPPING, columns, logs, write_columns

import jaxhil as package

pytestmark = pytest.mark.slow
TIME, COMMAND, POSITION, FORCE = "Time [ms]", "Command [mm]", "Position [mm]", "Force [kN]"
TOLD = "Fc [N]", "vd [mm/s]"
KINDS = "rest", "free", "contact"
PRIOR = "--prior", "rig-300kg"


@pytest.fixture(autouse=True)
def _undrawn(monkeypatch):
    monkeypatch.setattr("tuning.plots.identification.draw_identification", lambda *_: {})


@pytest.fixture(scope="module")
def day():
    """Return the columns of a defect-free rig's logs by file."""
    campaign = campaigns.campaign("clean", 0, speeds=(0.003, 0.006, 0.012) * 3, seconds=20.0, rest=2.0)
    return {f"{run.kind}_{index:02}.csv": columns(run) for index, run in enumerate(campaign.runs)}


def identified(jaxhil, folder, files, mapping=MAPPING, *options):
    """Run the command on these files with the contact law specified."""
    runs = "".join(f'\n[[runs]]\nfiles = "{kind}_*.csv"\nkind = "{kind}"\n' for kind in KINDS)
    (folder / "map.toml").write_text(mapping + runs)
    for name, table in files.items():
        write_columns(folder / name, table)
    whole = "--law", "kelvin_voigt", "--map", folder / "map.toml", "-o", folder / "out", "--json", *options
    return jaxhil("identify", *logs(folder), *whole)


def changed(day, column, change, kinds=KINDS, reveals=False):
    """Return all files with one column changed; columns that reveal the change remain only with `reveals`."""
    files = {}
    for name, table in day.items():
        remaining = {key: values for key, values in table.items() if reveals or key not in TOLD}
        here = column in remaining and name.split("_")[0] in kinds
        files[name] = {**remaining, column: change(remaining[column])} if here else remaining
    return files


def held(every):
    return lambda values: np.repeat(values[::every], every)[: len(values)]


def joined(every):
    """Keep every n-th row and interpolate linearly between these rows."""
    return lambda values: np.interp(np.arange(len(values)), np.arange(0, len(values), every), values[::every])


def noise(size):
    return lambda values: values + size * np.random.default_rng(0).standard_normal(len(values))


def swap_columns(first, second):
    return lambda day: {name: {**table, first: table[second], second: table[first]}
                        for name, table in changed(day, "", None).items()}  # fmt: skip


def only(kind, number=99):
    return lambda day: {name: day[name] for name in [file for file in day if file.startswith(kind)][:number]}


REFUSED = {
    "the force's sign": (lambda day: changed(day, FORCE, np.negative), "expected the other sign"),
    "N for kN": (lambda day: changed(day, FORCE, lambda values: 1e3 * values), "force in N, read as kN"),
    "m for mm": (lambda day: changed(day, COMMAND, lambda values: 1e-3 * values), "is its unit right?"),
    "position and command": (swap_columns(COMMAND, POSITION), "are the two swapped?"),
    "force and position": (swap_columns(FORCE, POSITION), "is its unit right?"),
    "commands held for 2 rows": (lambda day: changed(day, COMMAND, held(2)), "a new command every 2 rows"),
    "commands held for 4 rows": (lambda day: changed(day, COMMAND, held(4)), "a new command every 4 rows"),
    "commands against forces": (
        lambda day: changed(day, COMMAND, held(4), ("contact",), reveals=True), "a new command every 4 rows",
    ),
    "time backwards": (
        lambda day: changed(day, TIME, lambda values: values[::-1]), "expected an increasing time",
    ),
    "noise over all forces": (lambda day: changed(day, FORCE, noise(0.05)), "with a contact"),
    "a force range of 5 N": (
        lambda day: changed(day, FORCE, lambda values: np.clip(values, -5e-3, 5e-3)),
        "impulse that reverses 350 kg",
    ),
    "no force": (
        lambda day: {
            name: {key: values for key, values in table.items() if key not in (FORCE, *TOLD)}
            for name, table in day.items()
        },
        "found no such channel",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_identify_command_rejects_corrupted_logs_with_one_line_message(jaxhil, day, tmp_path, case):
    spoil, words = REFUSED[case]
    ran = identified(jaxhil, tmp_path, spoil(day))
    assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1 and "internal" not in ran.err
    assert words in ran.err and not list((tmp_path / "out").glob("*"))


def add_late_run(day):
    """Add a second free run whose readings are delayed by 3 ms."""
    run = day["free_01.csv"]
    return {**day, "free_99.csv": {**run, POSITION: np.roll(run[POSITION], 3)}}


BAD = {
    "commands joined over 10 rows": (lambda day: changed(day, COMMAND, joined(10)), "motion model"),
    "forces held for 4 rows": (lambda day: changed(day, FORCE, held(4)), "does not explain"),
    "a force range of 30 N": (
        lambda day: changed(day, FORCE, lambda values: np.clip(values, -0.03, 0.03)), "contact law",
    ),
    "a position range of 1 mm": (
        lambda day: changed(day, POSITION, lambda values: np.clip(values, -51.0, -49.0), ("free",)),
        "odd nonlinearity",
    ),
    "a force sensor that drifts": (
        lambda day: changed(day, FORCE, lambda values: values + 1e-2 * np.arange(len(values)) / 400.0),
        "does not explain",
    ),
    "two rigs": (add_late_run, "motion model"),
    "free motion alone": (only("free"), "do not determine contact.stiffness"),
    "touches alone": (only("contact"), "do not determine rig.simulator"),
    "rest alone": (only("rest"), "do not determine rig.simulator"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_identify_command_verdict_is_bad_for_corrupted_logs(jaxhil, day, tmp_path, case):
    spoil, words = BAD[case]
    ran = identified(jaxhil, tmp_path, spoil(day))
    assert ran.code == 1 and ran.document["verdict"] == "bad"
    # The verdict names the check with the largest effect; others may also be beyond the limit.
    failed = {check["name"] for check in ran.document["checks"] if check["there"] and check["effect"] > 0.01}
    assert words in ran.document["reason"] or words in failed


def test_identify_command_verdict_is_bad_for_log_at_rest_with_prior(jaxhil, day, tmp_path):
    ran = identified(jaxhil, tmp_path, only("rest")(day), MAPPING, *PRIOR)
    assert ran.code == 1 and "the file cannot be checked" in ran.document["reason"]


def gaps(day):
    """Remove 16 rows in the middle of every contact."""
    files = {}
    for name, table in day.items():
        deep = int(np.argmax(table[FORCE]))
        lost = slice(deep - 8, deep + 8) if name.startswith("contact") else slice(0)
        files[name] = {key: np.delete(values, lost) for key, values in table.items()}
    return files


FAIR = {
    "as it was": (lambda day: day, ()),
    "a gap in every contact": (gaps, ()),
    "two contacts": (only("contact", 2), PRIOR),
    "a force only in contact": (
        lambda day: changed(day, FORCE, lambda values: 0.0 * values, ("rest", "free"), reveals=True), (),
    ),
    "noise of 0.1 mm": (lambda day: changed(day, POSITION, noise(0.1)), ()),
}  # fmt: skip
TRUE = {
    "rig.simulator.natural_frequency": 12.0,
    "rig.simulator.delay": 0.0043,
    "rig.force_sensor.delay": 0.0037,
    "contact.stiffness.0": 1.2e5,
    "contact.damping.0": 650.0,
}


@pytest.mark.parametrize("case", FAIR)
def test_identify_command_is_accurate_despite_gaps_and_noise(jaxhil, day, tmp_path, case):
    spoil, options = FAIR[case]
    ran = identified(jaxhil, tmp_path, spoil(day), MAPPING, *options)
    # With fewer readings, force delay and damping are less certain; no other reason may make the verdict bad.
    uncertain = ran.document["reason"].startswith("Bad: the parameters are too uncertain")
    assert ran.code == 0 or (uncertain and case in ("a gap in every contact", "two contacts"))
    off = {item["key"]: (item["value"] - TRUE[item["key"]]) / item["std"]
           for item in ran.document["estimates"] if item["key"] in TRUE}  # fmt: skip
    assert "contact.stiffness.0" in off and "contact.stiffness.1" not in str(ran.document["estimates"])
    if not options:
        assert max(map(abs, off.values())) < 4.0


def test_identified_file_with_good_verdict_predicts_the_rig(jaxhil, day, tmp_path):
    """Interpolation between every fourth row is a low-pass, so a wrong model may fit the contacts."""
    ran = identified(jaxhil, tmp_path, changed(day, COMMAND, joined(4)))
    noise_free = {"force_sensor__noise_std": 0.0, "position_sensor__noise_std": 0.0}
    truth = package.simulate(campaign_rigs.mechanism("clean", **noise_free), "response_error")
    again = {f"rig.{key.replace('__', '.')}": value for key, value in noise_free.items()}
    again["approach.velocity"] = truth.mechanism.approach.velocity
    result = package.load(tmp_path / "out" / "mechanism.toml", again)
    result = package.simulate(result, "response_error", truth.gains)
    off = abs(result.contacts[0].restitution - truth.contacts[0].restitution)
    print(f"e is off by {off:.4f}: {ran.document['reason']}")
    assert ran.code == 1 or off < 0.01
