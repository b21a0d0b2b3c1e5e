"""Generated family of mechanisms: files that load, values within their ranges, reproducible."""

import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from family import LAWS, NUMBER, RANGES, family, texts, write
from lanes import QUICK

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.laws import CONTACT_LAWS as CONTACT_LAWS
from jaxhil.contact.laws import ContactParameters
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load


@pytest.fixture(scope="module")
def members():
    return family()


def undelayed(members, damped: bool) -> Any:
    """Return the package's `IdealContact` of the nominal mechanisms, in the order of the members."""
    references = {name: np.empty(len(members)) for name in IdealContact._fields}
    for name in LAWS:
        indices = [i for i, m in enumerate(members) if m.contact.law == name]
        contacts = [members[i].contact for i in indices]
        parameters: dict[str, Any] = {
            # The axis of segments (or depths) comes first.
            "stiffness": np.moveaxis(np.array([c.stiffness[0] for c in contacts]), 0, -1),
            "damping": np.array([c.damping[0] if damped else 0.0 for c in contacts]),
            "exponent": np.array([c.exponent for c in contacts]),
            "depths": np.moveaxis(np.array([c.depths for c in contacts]), 0, -1),
            "tension": np.zeros(len(indices), bool),
            **dict.fromkeys(("reference_depth", "unloading_ratio"), np.ones(len(indices))),
            **dict.fromkeys(("preload", "friction"), np.zeros(len(indices))),
        }
        mass = np.array([members[i].bodies.mass for i in indices])
        velocity = np.array([members[i].approach.velocity for i in indices])
        reference = jax.jit(CONTACT_LAWS[name].ideal_contact, compiler_options=QUICK)
        for field, values in reference(ContactParameters(**parameters), mass, velocity)._asdict().items():
            references[field][indices] = values
    return SimpleNamespace(**references)


def test_files_of_generated_mechanism_family_load_unchanged(tmp_path, members):
    paths = write(tmp_path)
    assert [load(path).mechanism for path in paths] == members
    assert len({path.name for path in paths}) == len({m.name for m in members}) == NUMBER
    assert all(path.stem == mechanism.name for path, mechanism in zip(paths, members, strict=True))


def test_generated_mechanism_files_are_reproducible_in_another_process(tmp_path):
    once = write(tmp_path / "once")
    command = [sys.executable, "-m", "tests.family", str(tmp_path / "again")]
    subprocess.run(command, check=True, cwd=Path(__file__).parent.parent, stdout=subprocess.DEVNULL)
    again = sorted((tmp_path / "again").iterdir())
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in sorted(once)]
    assert texts(seed=1) != texts(seed=0)


def test_smaller_generated_mechanism_family_is_prefix_of_larger_one(members):
    for number in (1, 3, 20):
        assert family(number) == members[:number]


def test_values_of_generated_mechanisms_fill_their_ranges(members):
    drawn = {
        "mass": [m.bodies.mass for m in members],
        "velocity": [m.approach.velocity for m in members],
        "force_delay": [m.rig.force_sensor.delay for m in members],
        "simulator_frequency": [m.rig.simulator.natural_frequency for m in members],
        "simulator_damping": [m.rig.simulator.damping_ratio for m in members],
        "simulator_delay": [m.rig.simulator.delay for m in members],
        # A contact lasts half a period; its restitution gives the damping ratio, to first order.
        "frequency": 1 / (2 * undelayed(members, damped=False).duration),
        "damping_ratio": -np.log(undelayed(members, damped=True).restitution) / math.pi,
    }
    for name, values in drawn.items():
        low, high = getattr(RANGES, name)
        # Values are rounded to six digits; the damping ratio is a first-order estimate.
        slack = 0.1 * high if name == "damping_ratio" else 1e-5 * high
        assert low - slack <= min(values) and max(values) <= high + slack, name
        assert min(values) < low + 0.05 * (high - low) and max(values) > high - 0.05 * (high - low), name
    assert abs(np.median(drawn["frequency"]) / math.sqrt(8) - 1) < 0.1
    assert all(m.rig.control_period == 1e-3 for m in members)


def test_generated_mechanism_family_has_every_contact_law_and_undamped_mechanisms(members):
    assert {m.contact.law for m in members} == set(LAWS)
    number = [sum(g.tuned(m) for g in COMPENSATORS["response_error"].gains) for m in members]
    damped = [m.contact.damping[0] > 0 for m in members]
    assert sum(damped) == NUMBER - NUMBER // 8
    assert all(n == (5 if d else 4) for n, d in zip(number, damped, strict=True))


def test_generated_mechanisms_have_uncertain_stiffness_force_delay_and_phase(members):
    for mechanism in members:
        assert set(mechanism.uncertainty) == {
            "contact.stiffness", "rig.force_sensor.delay", "approach.phase"
        }  # fmt: skip
        assert mechanism.uncertainty["contact.stiffness"].factor == [0.6, 1.6]
