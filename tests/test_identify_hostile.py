"""Logs of a good rig that somebody spoilt: refused in one line, or called bad, or right all the same."""

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
    monkeypatch.setattr("tuning.identification.pictures.draw", lambda *_: {})


@pytest.fixture(scope="module")
def day():
    """Columns of a clean rig's logs by file."""
    campaign = campaigns.campaign("clean", 0, speeds=(0.003, 0.006, 0.012) * 3, seconds=20.0, rest=2.0)
    return {f"{run.kind}_{place:02}.csv": columns(run) for place, run in enumerate(campaign.runs)}


def identified(jaxhil, folder, files, mapping=MAPPING, *given):
    """The command on these files, the law told."""
    runs = "".join(f'\n[[runs]]\nfiles = "{kind}_*.csv"\nkind = "{kind}"\n' for kind in KINDS)
    (folder / "map.toml").write_text(mapping + runs)
    for name, table in files.items():
        write_columns(folder / name, table)
    whole = "--law", "kelvin_voigt", "--map", folder / "map.toml", "-o", folder / "out", "--json", *given
    return jaxhil("identify", *logs(folder), *whole)


def changed(day, column, change, kinds=KINDS, told=False):
    """All files with a column changed; without what tells that it was, unless `told`."""
    files = {}
    for name, table in day.items():
        kept = {key: one for key, one in table.items() if told or key not in TOLD}
        here = column in kept and name.split("_")[0] in kinds
        files[name] = {**kept, column: change(kept[column])} if here else kept
    return files


def held(every):
    return lambda values: np.repeat(values[::every], every)[: len(values)]


def joined(every):
    """Logged every so many rows, and lines in between."""
    return lambda values: np.interp(np.arange(len(values)), np.arange(0, len(values), every), values[::every])


def noise(size):
    return lambda values: values + size * np.random.default_rng(0).standard_normal(len(values))


def swapped(one, other):
    return lambda day: {name: {**table, one: table[other], other: table[one]}
                        for name, table in changed(day, "", None).items()}  # fmt: skip


def only(kind, number=99):
    return lambda day: {name: day[name] for name in [one for one in day if one.startswith(kind)][:number]}


REFUSED = {
    "the force's sign": (lambda day: changed(day, FORCE, np.negative), "allowed the other sign"),
    "N for kN": (lambda day: changed(day, FORCE, lambda one: 1e3 * one), "is its unit right?"),
    "m for mm": (lambda day: changed(day, COMMAND, lambda one: 1e-3 * one), "is its unit right?"),
    "position and command": (swapped(COMMAND, POSITION), "are the two swapped?"),
    "force and position": (swapped(FORCE, POSITION), "is its unit right?"),
    "commands held for 2 rows": (lambda day: changed(day, COMMAND, held(2)), "changes every 2 rows"),
    "commands held for 4 rows": (lambda day: changed(day, COMMAND, held(4)), "changes every 4 rows"),
    "commands against forces": (
        lambda day: changed(day, COMMAND, held(4), ("contact",), told=True), "changes every 4 rows",
    ),
    "time backwards": (lambda day: changed(day, TIME, lambda one: one[::-1]), "allowed time that increases"),
    "noise over all forces": (lambda day: changed(day, FORCE, noise(0.05)), "with a contact where there is"),
    "a force range of 5 N": (
        lambda day: changed(day, FORCE, lambda one: np.clip(one, -5e-3, 5e-3)), "is its unit right?",
    ),
    "no force": (
        lambda day: {
            name: {key: one for key, one in table.items() if key not in (FORCE, *TOLD)}
            for name, table in day.items()
        },
        "found no such channel",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(jaxhil, day, tmp_path, case):
    spoil, words = REFUSED[case]
    ran = identified(jaxhil, tmp_path, spoil(day))
    assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1 and "internal" not in ran.err
    assert words in ran.err and not list((tmp_path / "out").glob("*"))


def late(day):
    """A second free run whose readings are late by 3 ms."""
    run = day["free_01.csv"]
    return {**day, "free_99.csv": {**run, POSITION: np.roll(run[POSITION], 3)}}


BAD = {
    "commands joined over 10 rows": (lambda day: changed(day, COMMAND, joined(10)), "motion model"),
    "forces held for 4 rows": (lambda day: changed(day, FORCE, held(4)), "does not explain"),
    "a force range of 30 N": (
        lambda day: changed(day, FORCE, lambda one: np.clip(one, -0.03, 0.03)), "contact law",
    ),
    "a position range of 1 mm": (
        lambda day: changed(day, POSITION, lambda one: np.clip(one, -51.0, -49.0), ("free",)),
        "odd nonlinearity",
    ),
    "a force sensor that drifts": (
        lambda day: changed(day, FORCE, lambda one: one + 1e-2 * np.arange(len(one)) / 400.0),
        "does not explain",
    ),
    "two rigs": (late, "motion model"),
    "free motion alone": (only("free"), "nor a prior tell contact.stiffness"),
    "touches alone": (only("contact"), "nor a prior tell rig.simulator"),
    "rest alone": (only("rest"), "nor a prior tell rig.simulator"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_called_bad(jaxhil, day, tmp_path, case):
    spoil, words = BAD[case]
    ran = identified(jaxhil, tmp_path, spoil(day))
    assert ran.code == 1 and ran.document["verdict"] == "bad" and words in ran.document["reason"]


def test_rest_alone_shows_nothing_even_with_a_prior(jaxhil, day, tmp_path):
    ran = identified(jaxhil, tmp_path, only("rest")(day), MAPPING, *PRIOR)
    assert ran.code == 1 and "nothing shows that the file is right" in ran.document["reason"]


def gaps(day):
    """16 rows lost in the middle of every contact."""
    files = {}
    for name, table in day.items():
        deep = int(np.argmax(table[FORCE]))
        lost = slice(deep - 8, deep + 8) if name.startswith("contact") else slice(0)
        files[name] = {key: np.delete(one, lost) for key, one in table.items()}
    return files


FAIR = {
    "as it was": (lambda day: day, ()),
    "a gap in every contact": (gaps, ()),
    "two contacts": (only("contact", 2), PRIOR),
    "a force only in contact": (
        lambda day: changed(day, FORCE, lambda one: 0.0 * one, ("rest", "free"), told=True), (),
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
def test_right_all_the_same(jaxhil, day, tmp_path, case):
    spoil, given = FAIR[case]
    ran = identified(jaxhil, tmp_path, spoil(day), MAPPING, *given)
    # Fewer readings tell the force delay from damping less well: only that may be wanting.
    uncertain = ran.document["reason"].startswith("Bad: the numbers are too uncertain")
    assert ran.code == 0 or (uncertain and case in ("a gap in every contact", "two contacts"))
    off = {one["key"]: (one["value"] - TRUE[one["key"]]) / one["std"]
           for one in ran.document["estimates"] if one["key"] in TRUE}  # fmt: skip
    assert "contact.stiffness.0" in off and "contact.stiffness.1" not in str(ran.document["estimates"])
    if not given:
        assert max(map(abs, off.values())) < 4.0


def test_what_is_called_good_predicts_the_rig(jaxhil, day, tmp_path):
    """Commands joined over 4 rows lose what is fast in them: another model may fit, of the same contacts."""
    ran = identified(jaxhil, tmp_path, changed(day, COMMAND, joined(4)))
    noise_free = {"force_sensor__noise_std": 0.0, "position_sensor__noise_std": 0.0}
    truth = package.simulate(campaign_rigs.mechanism("clean", **noise_free), "response_error")
    again = {f"rig.{key.replace('__', '.')}": value for key, value in noise_free.items()}
    again["approach.velocity"] = truth.mechanism.approach.velocity
    found = package.load(tmp_path / "out" / "mechanism.toml", again)
    found = package.simulate(found, "response_error", truth.gains)
    off = abs(found.contacts[0].restitution - truth.contacts[0].restitution)
    print(f"e is off by {off:.4f}: {ran.document['reason']}")
    assert ran.code == 1 or off < 0.01
