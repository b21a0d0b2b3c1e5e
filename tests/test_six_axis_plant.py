"""The exported six-axis controller, in Python and C, in a loop with an independent plant (`six_axis_plant`).

The plant shares no code with the package. At every tick, its motion must equal that of `simulate`, for
mechanisms with several surfaces, latches, bristle friction, legs and two robots. `test_six_axis_acceptance`
contains probe-drogue, whose sensor carries a tool.
"""

import functools

import c99_cases
import numpy as np
import pytest
from six_axis_c99 import ControllerInC, controller_of_bundle
from six_axis_documents import six_axis_document
from six_axis_plant import ideal_motion, nearest_points, read, run_on_rig

import jaxhil

TOLERANCE = 1e-8  # largest difference, divided by the largest value of the run
MECHANISMS = ("ring-capture", "petals", "claw-two-arms", "hydraulic-hexapod")
COMPENSATORS = ("none", "phase_lead", "impulse_ledger")
# Changes of `[approach]`: the file's contact, and another one.
APPROACHES = {
    "file": {},
    "other": {"offset": [-0.006, 0.008], "attitude": [-0.003, 0.004, -0.002], "phase": 0.8},
}
# Tick at which ideal contacts are compared, and tolerance. The package locates a capture to 1 us, and each
# later impact of a captured ring increases the difference.
IDEAL = {"ring-capture": (150, 1e-6), "claw-two-arms": (60, TOLERANCE), "hydraulic-hexapod": (270, TOLERANCE)}
LEADS = tuple(f"lag_lead_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
EARLY_TICKS = 80  # duration of the everyday sample: a first contact of ring-capture with its ring
# Twist of `simulate` at this tick (m/s, rad/s); the slow test compares it with a run.
EARLY_TWIST = [
    -0.0012325042906613582, -0.00410027920113925, -0.01590731091714784,
    -0.0037440574860522326, 0.0017957433715567182, -0.0003984345433920829,
]  # fmt: skip


@functools.cache
def simulated(name, compensator, approach):
    changes = {f"approach.{key}": value for key, value in APPROACHES[approach].items()}
    return jaxhil.simulate(jaxhil.load(name, changes), compensator)


def on_plant(name, compensator, approach, ticks, make=controller_of_bundle):
    """Return the run of the independent plant with an exported controller with the literature's gains."""
    document = six_axis_document(compensator, name)
    leads = np.array([document["gains"][lead]["value"] if lead in document["gains"] else 0 for lead in LEADS])
    return run_on_rig(read(name, **APPROACHES[approach]), ticks, make(document), leads)


def difference(values, expected):
    """Return the largest difference of three numbers, divided by the largest of the expected numbers."""
    values, expected = (np.reshape(np.asarray(part), (-1, 2, 3)) for part in (values, expected))
    worst, size = (np.max(np.abs(part), axis=(0, 2)) for part in (values - expected, expected))
    return np.max(worst / size)


@pytest.mark.slow
@pytest.mark.parametrize("approach", APPROACHES)
@pytest.mark.parametrize("controller", ["python_file", "c"])
@pytest.mark.parametrize("compensator", COMPENSATORS)
@pytest.mark.parametrize("name", MECHANISMS)
def test_exported_controller_on_independent_plant_gives_motion_of_simulate(
    name, compensator, controller, approach, tmp_path
):
    if controller == "c" and c99_cases.COMPILER is None:
        pytest.skip("no C compiler (cc) on this machine")
    run = simulated(name, compensator, approach)
    ticks = len(run.ticks.time)
    make = controller_of_bundle if controller == "python_file" else lambda doc: ControllerInC(doc, tmp_path)
    plant = on_plant(name, compensator, approach, ticks, make)
    begins = np.diff(plant.touches.astype(int), axis=0, prepend=0) > 0
    assert np.sum(begins) == run.episodes[0].touches > 0
    # Contact by contact: at the last tick before the next pair touches, or at the end.
    after = [*(np.flatnonzero(begins.any(axis=1))[1:] - 1), ticks - 1]
    each = [difference(plant.twist[tick], run.ticks.twist_desired[tick]) for tick in after]
    errors = {
        "contacts": max(each),
        "final": difference(plant.final[1], run.final.twist),
        "twist": difference(plant.twist, run.ticks.twist_desired),
        "coordinates": difference(plant.coordinates, run.ticks.desired),
        "wrench": difference(plant.wrench, run.ticks.wrench),
    }
    print(name, compensator, controller, approach, run.status, len(each), errors)
    assert max(errors.values()) <= TOLERANCE


def test_exported_ledger_on_independent_plant_gives_early_motion_of_simulate():
    plant = on_plant("ring-capture", "impulse_ledger", "file", EARLY_TICKS + 1)
    assert plant.touches.any() and difference(plant.twist[-1], EARLY_TWIST) <= TOLERANCE


@pytest.mark.slow
def test_early_twist_is_that_of_simulate():
    run = simulated("ring-capture", "impulse_ledger", "file")
    assert difference(run.ticks.twist_desired[EARLY_TICKS], EARLY_TWIST) <= TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", IDEAL)
def test_ideal_contact_of_independent_plant_gives_ideal_motion_of_simulate(name):
    tick, tolerance = IDEAL[name]
    run, table = simulated(name, "none", "file"), read(name)
    _, twist = ideal_motion(table, tick * table["rig"]["control_period"])
    error = difference(twist, run.ticks.twist_ideal[tick])
    print(name, error)
    assert np.max(run.ticks.wrench_ideal[:tick]) > 10 and error <= tolerance


def test_nearest_points_of_segments_agree_with_search():
    """Include crossing, parallel and collinear segments."""
    random = np.random.default_rng(2)
    parts = np.linspace(0, 1, 101)
    for case in range(12):
        a, b, c, d = random.uniform(-1, 1, (4, 3))
        if case % 3 == 0:
            d = c + random.uniform(-1, 1) * (b - a)
        p, q = nearest_points(a, b, c, d)
        first, second = (np.outer(1 - parts, one) + np.outer(parts, other) for one, other in ((a, b), (c, d)))
        least = np.min(np.linalg.norm(first[:, None] - second, axis=2))
        assert least - 0.02 < np.linalg.norm(p - q) < least + 1e-9
