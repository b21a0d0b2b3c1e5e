"""Status of the impulse ledger, tick by tick and for a contact, and its use by the watchdog.

Status counts in C are compared with those in Python.
"""

import ctypes
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import c99_cases
import numpy as np
import pytest
from gain_documents import gain_document
from law_contacts import LAW, Ran, run
from rig_lock_step import controller

from jaxhil import laws
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import Controller
from jaxhil.rig.faults import LAW_IN_DOUBT, RESTITUTION, fault_names
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.law_status import (
    IDENTIFIED,
    NOISY,
    NOT_REACHED,
    OUT_OF_CONTACT,
    SATURATED,
    STATUS_NAMES,
    STATUSES,
    TOO_SHORT,
    UNEXPLAINED,
    UNSURE,
    ContactRecord,
    StatusCount,
    contact_record,
)
from jaxhil.rig.limits import NO_LIMITS


class Kind(NamedTuple):
    """Kind of contact: suite, overrides, gains that differ, and expected status of the compensator."""

    suite: str
    changes: tuple[str, ...]
    gains: Mapping[str, float]
    status: str


KINDS = {
    "ordinary": Kind("noisy", (), {}, "identified"),
    "8 Hz": Kind("fast", ("contact.stiffness=[884316.0]",), {}, "too_short"),
    "surface 4 mm deeper": Kind("noisy", ("rig.contact_plane=4e-3",), {}, "identified"),
    "noisy force": Kind("noisy", ("rig.force_sensor.noise_std=2.667",), {}, "noisy"),
    "force 1 ms older than specified": Kind(
        "noisy", (), {"identification_delay": 0.007, "delay_spread": 0.0}, "unexplained"
    ),
    "damped": Kind("damped", ("contact.damping=[600.0]",), {}, "identified"),
}
WATCHED = {"settling": 0.02, "free_force": 20.0}
LIMITS = {
    "none": {},
    "no energies": WATCHED,
    "energies": {**WATCHED, "equivalent_mass": 350.0, "energy_balance": 1e-6},
}


def gain_file(kind: Kind, limits: Mapping[str, float]) -> tuple[Mechanism, GainFile]:
    mechanism = load(f"suite-{kind.suite}", list(kind.changes)).mechanism
    gains = literature_gains(mechanism, LAW) | dict(kind.gains)
    made = GainFile(LAW, gains, mechanism.rig.control_period, mechanism.contact.clearance)
    return mechanism, made._replace(limits={**NO_LIMITS, **limits})


@cache
def run_kind(name: str, limits: str) -> tuple[Controller, Ran]:
    """Run a kind of contact under these limits; return the record and its controller."""
    mechanism, made = gain_file(KINDS[name], LIMITS[limits])
    law = Controller(made)
    return law, run(mechanism, law)


# Without energy audit, all kinds run every day; with it, only some.
@pytest.mark.parametrize(
    "name, limits",
    [
        pytest.param(name, limits, marks=() if limits == "no energies" or number < 3 else pytest.mark.slow)
        for limits in LIMITS
        for number, name in enumerate(KINDS)
    ],
)
def test_status_of_contact_is_most_frequent_status_of_its_ticks(name, limits):
    """The status is reported on one tick after the contact, without a trip, with and without energy audit."""
    law, result = run_kind(name, limits)
    record, wanted = law.last_contact, KINDS[name].status
    assert (record.number, record.status) == (1, wanted)
    assert law.status == "ok" and fault_names(law.seen) == (
        [] if wanted == "identified" else ["law_in_doubt"]
    )
    (raised,) = np.nonzero(result.faults) if wanted != "identified" else ([len(result.faults)],)
    assert len(raised) == 1
    statuses = result.said[: raised[0]]
    assert record.ticks == len(statuses) - statuses.count("out_of_contact") > 50
    for status in ("unsure", "saturated", "too_short", "noisy"):
        assert getattr(record, status) == statuses.count(status)


@pytest.mark.parametrize("nearer", [1e-3, 4e-3])
def test_contact_in_front_of_specified_surface_is_audited_by_watchdog(nearer):
    changes = (f"rig.contact_plane={-nearer}",)
    mechanism, made = gain_file(Kind("noisy", changes, {}, "identified"), {"settling": 0.02})
    law = Controller(made)
    rows = run(mechanism, law).rows
    assert np.all(rows[:, 2] < 0) and law.last_contact[:2] == (1, "identified")


COUNTED = """
static jaxhil_status_count statuses;
void count_begin(void) { jaxhil_status_count_restart(&statuses); }
void count_take(int status) { jaxhil_status_count_take(&statuses, status); }
void count_read(int measured, long long *numbers) {
    const jaxhil_contact_record record = jaxhil_status_count_count(&statuses, 7, measured != 0);
    numbers[0] = record.number, numbers[1] = record.status, numbers[2] = record.ticks;
    numbers[3] = record.unsure, numbers[4] = record.saturated, numbers[5] = record.too_short;
    numbers[6] = record.noisy;
}
"""


@pytest.fixture(scope="module")
def counting_in_c(tmp_path_factory):
    """Load the C code that counts statuses as a shared library."""
    if c99_cases.COMPILER is None:
        pytest.skip("no C compiler (cc) on this machine")
    folder = c99_cases.write_sources(tmp_path_factory.mktemp("status"), gain_document("none"))
    (folder / "counted.c").write_text(f'#include "jaxhil_controller.c"\n{COUNTED}')
    return ctypes.CDLL(str(c99_cases.compiled(folder, "counted.c", "counted.so", "-shared", "-fPIC")))


def test_contact_status_counts_in_c_agree_with_python(counting_in_c):
    rng = np.random.default_rng(0)
    numbers = [status.number for status in STATUSES if status.number != NOT_REACHED]
    record_type, statuses = ctypes.c_longlong * 7, set()
    for _ in range(2000):
        shares = rng.dirichlet(np.full(len(numbers), 0.2))
        ticks = rng.choice(numbers, 40, p=shares).tolist()
        measured = bool(rng.random() < 0.9)
        count = StatusCount()
        counting_in_c.count_begin()
        for status in ticks:
            count.take(status)
            counting_in_c.count_take(status)
        values = record_type()
        counting_in_c.count_read(int(measured), values)
        record = contact_record(count.count(7, measured))
        assert STATUS_NAMES[values[1]] == record.status
        assert [values[0], *values[2:]] == [record.number, *record[2:]]
        statuses.add(record.status)
    assert statuses == {*STATUS_NAMES.values()} - {"out_of_contact", "unstated"}


def test_sample_contacts_cover_every_status_of_impulse_ledger():
    records = [run_kind(name, "no energies") for name in KINDS]
    statuses = {name for _, contact in records for name in contact.said}
    never = {"unstated", "not_reached"}
    assert statuses == {*STATUS_NAMES.values()} - never
    assert {controller.last_contact.status for controller, _ in records} == {
        *("identified", "too_short", "noisy", "unexplained")
    }


def test_contact_without_measured_force_has_status_not_reached():
    """The model passes the surface and returns without a measured force.

    Reasons: the hardware never touches, a dead zone hides its contact, or the contact has a single reading.
    """
    mechanism = load("suite-noise-free").mechanism
    time = 1e-3 * np.arange(260)
    motion = 2e-4 * np.sin(25.0 * (time - 0.0203))
    never, touching = np.full(len(time), -1e-4), 2e-4 * np.sin(25.0 * (time - 0.0303))
    none = np.zeros(len(time))
    single = np.where(np.arange(len(time)) == 90, 3.0, 0.0)
    for measured, force, reached in (
        (never, none, False),
        (touching, none, False),
        (touching, single, True),
        (touching, -0.01 * np.cos(time), False),
    ):
        law = controller(mechanism, LAW, literature_gains(mechanism, LAW), settling=0.02, fading=0.01)
        velocity = 5e-3 * np.cos(25.0 * (time - 0.0203))
        for row in np.stack([force, motion, velocity, measured], axis=1):
            law.step(*row)
        record = law.last_contact
        assert record.number == 1 and (record.status == "not_reached") != reached, record
        assert law.seen == LAW_IN_DOUBT


def test_last_contact_record_remains_until_next_contact_is_audited():
    mechanism, made = gain_file(KINDS["8 Hz"], {})
    law = Controller(made)
    assert law.law_status == "out_of_contact" and law.last_contact == ContactRecord()
    run(mechanism, law)
    first = law.last_contact
    assert first.number == 1
    law.next_contact()
    assert law.last_contact == first and law.faults == 0
    assert law.reset() and law.last_contact == first and law.seen == 0
    run(*gain_file(KINDS["ordinary"], {})[:1], law)
    assert law.last_contact[:2] == (2, "identified")


def test_unfinished_contact_is_audited_when_next_contact_is_announced():
    for limits in LIMITS.values():
        mechanism, made = gain_file(KINDS["8 Hz"], {**limits, "settling": 5.0})
        law = Controller(made)
        result = run(mechanism, law)
        assert not np.any(result.faults) and law.last_contact.number == 0
        law.next_contact()
        assert law.faults == law.seen == LAW_IN_DOUBT and not law.tripped
        assert law.last_contact[:2] == (1, "too_short")
        law.step(0.0, -1e-3, 5e-3, -1e-3)
        assert law.faults == 0 and law.seen == LAW_IN_DOUBT


def test_restitution_trip_reports_status_of_compensator():
    mechanism, made = gain_file(KINDS["8 Hz"], {**LIMITS["energies"], "restitution_margin": 1e-6})
    law = Controller(made)
    result = run(mechanism, law)
    assert RESTITUTION | LAW_IN_DOUBT in result.faults and law.cause == RESTITUTION
    assert law.status.startswith("tripped: restitution (contact 1: restitution ")
    assert law.status.endswith(", law too short)")


@pytest.mark.parametrize("name", [name for name in laws.built_in_compensators() if name != LAW])
def test_compensators_without_status_report_none(name):
    mechanism = load("suite-noisy").mechanism
    law = controller(mechanism, name, literature_gains(mechanism, name), **LIMITS["energies"])
    result = run(mechanism, law)
    assert set(result.said) == {"unstated"} and law.last_contact == ContactRecord()
    law.next_contact()
    assert not law.seen & LAW_IN_DOUBT and law._watchdog.contacts == 1
    assert law.last_contact.number == 0
    law = controller(mechanism, name, literature_gains(mechanism, name), **WATCHED)
    assert not law._watchdog.on


@pytest.mark.parametrize(
    ("counts", "status"),
    [
        ({}, UNSURE),
        ({OUT_OF_CONTACT: 50}, UNSURE),
        ({OUT_OF_CONTACT: 500, IDENTIFIED: 6, UNSURE: 4}, IDENTIFIED),
        ({IDENTIFIED: 59, UNSURE: 41}, UNSURE),
        ({IDENTIFIED: 59, UNSURE: 21, TOO_SHORT: 20}, UNSURE),
        ({IDENTIFIED: 59, UNSURE: 20, TOO_SHORT: 21}, TOO_SHORT),
        ({SATURATED: 99, IDENTIFIED: 1, OUT_OF_CONTACT: 9}, IDENTIFIED),
        ({UNSURE: 40, IDENTIFIED: 59, SATURATED: 1, OUT_OF_CONTACT: 9}, SATURATED),
        ({UNEXPLAINED: 9, IDENTIFIED: 1}, IDENTIFIED),
        ({IDENTIFIED: 99, UNEXPLAINED: 1, OUT_OF_CONTACT: 9}, UNEXPLAINED),
        ({NOISY: 41, UNEXPLAINED: 59}, NOISY),
        ({SATURATED: 59, UNSURE: 41}, UNSURE),
        ({IDENTIFIED: 59, UNSURE: 10, TOO_SHORT: 16, NOISY: 15}, TOO_SHORT),
        ({IDENTIFIED: 59, UNSURE: 10, TOO_SHORT: 15, NOISY: 16}, NOISY),
        ({IDENTIFIED: 60, TOO_SHORT: 20, NOISY: 20}, IDENTIFIED),
        ({IDENTIFIED: 59, TOO_SHORT: 20, NOISY: 21}, NOISY),
    ],
)
def test_contact_status_follows_from_status_counts(counts, status):
    made = StatusCount()
    for one, number in counts.items():
        for _ in range(number):
            made.take(one)
    record = contact_record(made.count(7, measured=True))
    assert (record.number, record.status) == (7, STATUS_NAMES[status])
    assert record.ticks == sum(counts.values()) - counts.get(OUT_OF_CONTACT, 0)
    assert record.in_doubt == (status in (UNSURE, SATURATED, TOO_SHORT, NOISY, UNEXPLAINED))
