"""Adding a law takes a file each in JAX and Python, an entry in the list of laws, one in the registry."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = {
    "jaxhil/compensators/toy.py": '''
"""A toy: F_c = F + toy_share (F - F of the tick before)."""

from typing import ClassVar

import jax.numpy as jnp

from jaxhil.compensators.base import Compensator, Gain


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
''',
    "jaxhil/runtime/laws/toy.py": '''
"""A toy: F_c = F + toy_share (F - F of the tick before)."""

from ..registry import Compensator, GainSpecification, register


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
# Agreement of JAX and runtime, derivatives, export with the bundle's self-test, of C, too.
RUN = (
    "test_compensators.py::test_jax_and_runtime_agree_on_contacts_and_on_noise",
    "test_compensators.py::test_derivatives_by_every_gain_are_those_of_differences",
    "test_export.py::test_every_compensator_that_can_be_tuned_can_be_exported",
)


@pytest.fixture
def copied(tmp_path):
    """The repository with a toy law in it."""
    folder = tmp_path / "copy"
    for part in ("jaxhil", "tuning", "tests"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    for name, text in FILES.items():
        (folder / name).write_text(text.lstrip())
    laws = folder / "jaxhil/runtime/laws/__init__.py"
    text, entries = re.subn(r'\n    "none",\n', r'\n    "none",\n    "toy",\n', laws.read_text())
    assert entries == 1
    laws.write_text(text)
    registry = folder / "jaxhil/compensators/__init__.py"
    text, entries = re.subn(
        r"\n    NoCompensator\(\),\n", r"\n    NoCompensator(),\n    Toy(),\n", registry.read_text()
    )
    assert entries == 1
    imported = "from jaxhil.compensators.toy import Toy\n"
    registry.write_text(text.replace("from jaxhil.mechanism", imported + "from jaxhil.mechanism"))
    return folder


@pytest.mark.slow
def test_a_law_of_two_files_and_two_entries_is_tested_and_exported(copied):
    """By the tests named `...[toy...]`, in a process that sees the copy alone."""
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "-k", "toy", *RUN]
    environment = {**os.environ, "PYTHONPATH": str(copied)}
    folder = copied / "tests"
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    output = ran.stdout + ran.stderr
    assert ran.returncode == 0, output
    assert f"\n{len(RUN)} passed" in output and "skipped" not in output, output
