"""Toy contact law with an additional key, added to a copy of the package by one file and one entry."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TOY = '''
"""A toy: a spring whose slope from the origin doubles at a depth, and a damper."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import clamp_force
from jaxhil.contact.keys import ContactKey
from jaxhil.contact.regression import RegressionFamily, Regression


class Toy(ContactLaw):
    """F = max(0, k d (1 + d/d_2) + b d'), d_2 the `doubling_depth`."""

    name: ClassVar[str] = "toy"
    keys: ClassVar = (
        ContactKey("doubling_depth", "where {laws} is twice as stiff", "m", {"gt": 0.0}, neutral=1.0),
    )

    @property
    def is_locally_parabolic(self):
        return True

    def step(self, parameters, state, penetration, rate):
        force = self.separation_function(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def onset_force(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(force > 0, force, 0)

    def separation_function(self, parameters, state, penetration, rate):
        stiffening = 1 + penetration / parameters.doubling_depth
        return parameters.stiffness * penetration * stiffening + parameters.damping * rate

    def tangent_stiffness(self, parameters, mass, velocity):
        return parameters.stiffness * (1 + 2 * velocity * np.sqrt(mass / parameters.stiffness))

    def perturb_damping(self, drawn, ratio, mass, velocity):
        return "damping", drawn("damping") + 2 * ratio * np.sqrt(drawn("stiffness") * mass)

    def as_float_law(self, contact, stiffness, damping):
        def spring(depth, rate):
            return stiffness * depth * (1.0 + depth / contact.doubling_depth) + damping * rate

        return clamp_force(spring, lambda rate: damping * rate)

    def regression(self, contact):
        names = ("stiffness", "square", "damping")
        return Regression("toy", lambda d, v: [d, d**2], names, lambda d, v: [v])

    def families(self, deepest, entries):
        return [RegressionFamily(lambda _: self.regression(None))] if entries == 1 else []

    def coefficients(self, contact, stiffness, damping):
        return [stiffness, stiffness / contact.doubling_depth, damping]

    def file_values(self, fitted, entry):
        depth = fitted["stiffness"] / np.maximum(fitted["square"], 1e-9)
        return {**super().file_values(fitted, entry), "contact.doubling_depth": depth}
'''
# Keys, messages for rejected values, and the rehearsal of the rig work without JAX.
WITHOUT_JAX = """
import sys
from jaxhil.errors import InputError
from jaxhil.mechanism.file import load
from jaxhil.mechanism.keys import describe_tables
from tuning.rig.plant import RigHardware

toy = {"contact.law": "toy", "contact.damping": [400.0], "contact.doubling_depth": 3e-4}
mechanism = load("rig-300kg", toy).mechanism
for wrong in ({"contact.law": "toy"}, {"contact.law": "hertz"}, {**toy, "contact.law": "kelvin_voigt"}):
    try:
        load("rig-300kg", wrong)
    except InputError as error:
        print(error)
[key] = [key for table in describe_tables() for key in table.keys if key.name == "doubling_depth"]
print(key.meaning, key.unit, key.allowed, key.users, sep="; ")
plant = RigHardware(mechanism)
plant.begin(-1e-5, 0.01, -1e-5, 0)
for tick in range(80):
    plant.move(-1e-5 + 0.01 * 0.001 * tick)
print(plant.force > 0.0, "jax" in sys.modules)
"""
IN_THE_SIMULATION = """
import contextlib, io
import jaxhil, numpy as np, tuning
from jaxhil.mechanism.uncertainty import draw
from tuning.__main__ import main
from tuning.transparency.damping_perturbations import perturb_damping
from tuning.transparency.probes import build_probed_scenarios

toy = {"contact.law": "toy", "contact.damping": [400.0], "contact.doubling_depth": 3e-4}
mechanism = jaxhil.load("rig-300kg", toy)
[contact] = jaxhil.simulate(mechanism, "phase_lead").contacts
print(contact.status, contact.reference_restitution)

tuned = tuning.tune(mechanism, "phase_lead", scenarios=4, starts=1, steps=2, validation=7)
tuned.save("gains.json")
print(tuned.document["mechanism"]["contact"]["doubling_depth"])
print(tuning.sweep("gains.json", scenarios=16).table.num_rows)

draws = draw(mechanism, 6, 0)
probed = build_probed_scenarios(mechanism, draws)
perturbed, values = perturb_damping(mechanism, draws)
print(np.all((probed.early > 0) & (probed.late > 0)), perturbed.contact.law)
print(np.min(values["contact.damping"]), np.max(values["contact.damping"]) > 1000)

logs = [f"contact_{number}.csv" for number in range(5)]
with contextlib.redirect_stdout(io.StringIO()):
    for log, speed in zip(logs, (0.004, 0.008, 0.016, 0.006, 0.012)):
        changes = {**toy, "approach.velocity": speed, "uncertainty": {}, "rig.force_sensor.noise_std": 0.05}
        overrides = [part for key in changes for part in ("--set", f"{key}={changes[key]}")]
        main(["simulate", "rig-300kg", *overrides, "--log", log])
    main(["identify", *logs, "--prior", "rig-300kg", "--law", "toy", "-o", "identified"])
contact = jaxhil.load("identified/mechanism.toml").contact
print(contact.law, contact.stiffness[0], contact.damping[0], contact.doubling_depth)
"""


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """Return a copy of the package with the toy law: one new file and one entry."""
    folder = tmp_path_factory.mktemp("copy")
    for part in ("jaxhil", "tuning"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "jaxhil/contact/toy.py").write_text(TOY.lstrip())
    registry = folder / "jaxhil/contact/laws.py"
    text, entries = re.subn(r"\n        Preloaded\(\),\n", r"\g<0>        Toy(),\n", registry.read_text())
    assert entries == 1
    registry.write_text(
        text.replace("from jaxhil.errors", "from jaxhil.contact.toy import Toy\nfrom jaxhil.errors", 1)
    )
    return folder


def run(copied, folder, script):
    """Return the output of a script in a process that imports only the copy."""
    environment = {**os.environ, "PYTHONPATH": str(copied)}
    ran = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def test_toy_contact_law_is_read_and_rehearsed_without_jax(copied, tmp_path):
    needs, unknown, other, key, rehearsed = run(copied, tmp_path, WITHOUT_JAX).splitlines()
    assert "contact.doubling_depth: found nothing, expected a number > 0 m (law toy needs it)" in needs
    assert "contact.law: found 'hertz', expected one of linear, " in unknown and unknown.endswith(", toy")
    assert "contact.doubling_depth: found 0.0003, expected nothing (only for law toy)" in other
    assert key == "where toy is twice as stiff; m; a number > 0 m; ('toy',)"
    assert rehearsed == "True False"


@pytest.mark.slow
def test_toy_contact_law_is_simulated_tuned_swept_probed_and_identified(copied, tmp_path):
    simulated, tuned, swept, probed, perturbed, identified = run(
        copied, tmp_path, IN_THE_SIMULATION
    ).splitlines()
    status, restitution = simulated.split()
    assert status == "ok" and 0.85 < float(restitution) < 0.95
    assert (tuned, swept) == ("0.0003", "16")
    assert probed == "True toy" and perturbed == "400.0 True"
    law, *numbers = identified.split()
    assert law == "toy"
    assert [float(number) for number in numbers] == pytest.approx([1.066e5, 400.0, 3e-4], rel=0.1)
