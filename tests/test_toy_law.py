"""Toy compensator, added to a copy of the package as a folder of two files: JAX and rig."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = {
    "jaxhil/laws/toy/simulation.py": '''
"""A toy: F_c = F + toy_share (F - F of the tick before)."""

from typing import ClassVar

import jax.numpy as jnp

from jaxhil.laws.simulation_base import Compensator, Gain


class Toy(Compensator):
    """F_c = F + toy_share (F - F_before)."""

    name: ClassVar[str] = "toy"
    knows: ClassVar[tuple[str, ...]] = ()
    gains: ClassVar[tuple[Gain, ...]] = (
        Gain("toy_share", "1", lambda m: 0.0, lambda m: 4.0, lambda m: 1.0, neutral=0.0),
    )

    def init(self, gains, constants, ring):
        return jnp.zeros_like(constants.control_period)

    def restart(self, gains, state, begins, fresh):
        return jnp.where(begins, 0, state)

    def step(self, prepared, state, signals, tick):
        force = signals.force_measured
        return force + prepared["toy_share"] * (force - state), force

    def noise_amplification(self, gains, constants):
        share = gains["toy_share"]
        return jnp.sqrt((1 + share) ** 2 + share**2)


COMPENSATOR = Toy()
''',
    "jaxhil/laws/toy/rig.py": '''
"""A toy: F_c = F + toy_share (F - F of the tick before)."""

from jaxhil.rig.registry import Compensator, GainSpecification, register


@register("toy")
class Toy(Compensator):
    """F_c = F + toy_share (F - F_before)."""

    gains = {"toy_share": GainSpecification("1")}

    def __init__(self, gains, period, clearance):
        self._share = gains["toy_share"]
        self._before = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured):
        command = force_measured + self._share * (force_measured - self._before)
        self._before = force_measured
        return command

    def reset(self):
        self._before = 0.0
''',
}
# Agreement of JAX and runtime, derivatives, and export with the bundle's self-test, in C too.
RUN = (
    "test_compensators.py::test_jax_and_runtime_compensators_agree_for_contacts_and_for_noise",
    "test_compensators.py::test_compensator_gain_derivatives_match_finite_differences",
    "test_export.py::test_export_builds_bundle_for_every_compensator",
)


@pytest.fixture
def copied(tmp_path):
    """Return a copy of the repository with a toy compensator."""
    folder = tmp_path / "copy"
    for part in ("jaxhil", "tuning", "tests"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    for name, text in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text.lstrip())
    return folder


@pytest.mark.slow
def test_toy_compensator_of_two_files_is_tested_and_exported(copied):
    """Run the tests named `...[toy...]` in a process that imports only the copy."""
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "-k", "toy", *RUN]
    environment = {**os.environ, "PYTHONPATH": str(copied)}
    folder = copied / "tests"
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    output = ran.stdout + ran.stderr
    assert ran.returncode == 0, output
    assert f"\n{len(RUN)} passed" in output and "skipped" not in output, output
