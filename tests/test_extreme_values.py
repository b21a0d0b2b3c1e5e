"""Extreme values of every numeric key: simulated, or rejected with a one-line message, without hanging."""

import itertools
import math
import time

import pytest

import jaxhil
from jaxhil.mechanism.file import load
from jaxhil.mechanism.number_ranges import numeric_keys
from jaxhil.simulation.plausibility import check_run, summarise_mechanism

VALUES = "0 -0.0 1e-320 1e-300 1e-100 1e-9 1e9 1e100 1e300 1.7e308 nan inf".split()
KEYS = [key for key in numeric_keys() if not key.startswith("uncertainty")]
ENTRIES = {"contact.stiffness": "[0]", "contact.depths": "[0]", "rig.simulator.coefficients": "[1]"}
OTHERS = {
    "one contact": ("rig-300kg", []),
    "rattling": ("rattling", []),
    "hertz": ("suite-hertz", []),
    "layers": ("suite-layered", []),
    "hardening": ("suite-hardening", []),
    "depth-damped": ("suite-depth-damped", []),
    "elastoplastic": ("suite-elastoplastic", []),
    "preloaded": ("suite-friction", []),
    "two masses": ("rig-300kg", ["bodies={chaser_mass=700, target_mass=500}"]),
    "first order": ("rig-300kg", ["rig.simulator={model='first_order', time_constant=0.01}"]),
    "third order": ("rig-300kg", ["rig.simulator={model='third_order', coefficients=[0.02, 1.6e-4, 5e-7]}"]),
    "transfer function": (
        "rig-300kg",
        ["rig.simulator={model='transfer_function', numerator=[1.0], denominator=[1e-3, 0.05, 1.0]}"],
    ),
}
# Overrides without which a key is invalid.
COMPANIONS = {
    "rig.force_sensor.filter.cutoff": ["rig.force_sensor.filter={kind='bessel', order=2, cutoff=200.0}"]
}
SAMPLE = 11  # the daily run takes every 11th value
LONGEST = 120.0  # time limit [s]; on a busy machine most of it is compilation


def overrides(others, key, value):
    """Yield overrides that set a key to a value: the whole entry, or one entry of its list."""
    for path in (key, key + ENTRIES.get(key, "[0]")):
        certain = ["uncertainty={}"] if others else []
        yield [*certain, *others, *COMPANIONS.get(key, []), f"{path}={value}"]


def check_simulate(command, name, changes):
    begun = time.monotonic()
    ran = command("simulate", name, *(f"--set={change}" for change in changes))
    assert time.monotonic() - begun < LONGEST
    if ran.code == 2:
        assert ran.out == "" and ran.err.startswith(f"jaxhil: {name}: ") and ran.err.count("\n") == 1
        assert "internal" not in ran.err
    else:
        assert ran.code in (0, 1) and ran.out.startswith(f"{name}: equivalent mass ")
        assert all(line.startswith(f"warning: {name}: ") for line in ran.err.splitlines())


@pytest.mark.parametrize("every", [SAMPLE, pytest.param(1, marks=pytest.mark.slow)], ids=["some", "all"])
@pytest.mark.parametrize("which", OTHERS)
def test_extreme_values_are_loaded_or_rejected_with_one_line_message(which, every):
    name, others = OTHERS[which]
    first = [*OTHERS].index(which) % every
    for key, value in list(itertools.product(KEYS, VALUES))[first::every]:
        for changes in overrides(others, key, value):
            try:
                mechanism = load(name, changes).mechanism
                check_run(mechanism, drawn=True)
            except jaxhil.InputError as refused:
                message = str(refused)
                assert message.startswith(f"{name}: ") and message.isprintable() and len(message) < 500
            else:
                line = summarise_mechanism(mechanism).line(name)
                assert line.isprintable() and math.isfinite(summarise_mechanism(mechanism).duration)


@pytest.mark.parametrize(
    "change",
    [
        *("contact.stiffness=1e100", "contact.stiffness=1e-100", "bodies.equivalent_mass=1e-100"),
        *("approach.velocity=1e100", "contact.damping=1e100", "rig.contact_plane=1e100"),
        *("rig.control_period=1e-9", "contact.stiffness=[1e308]", "bodies.equivalent_mass=1e-320"),
        *("rig.simulator.natural_frequency=1e9", "rig.simulator.natural_frequency=1e-100"),
    ],
)
def test_extreme_value_is_simulated_or_rejected_with_one_line_message(jaxhil, change):
    check_simulate(jaxhil, "rig-300kg", ["uncertainty={}", change])


def test_load_rejects_mechanism_with_very_long_list():
    for key in ("contact.stiffness", "contact.damping", "contact.depths"):
        with pytest.raises(jaxhil.InputError, match=f"{key}: found a list of 10000000 entries"):
            jaxhil.load("rig-300kg", {key: [1.0] * 10_000_000})


@pytest.mark.slow
@pytest.mark.parametrize("which", OTHERS)
def test_every_extreme_value_is_simulated_or_rejected_with_one_line_message(jaxhil, which):
    name, others = OTHERS[which]
    for key, value in itertools.product(KEYS, VALUES):
        for changes in overrides(others, key, value):
            check_simulate(jaxhil, name, changes)
