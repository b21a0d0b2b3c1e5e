"""False onsets of the six-axis impulse ledger in hours of sensor noise, with the generated C controller."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from c99_cases import compiled
from six_axis_c99 import DRIVER, SixAxisBatch, rows_of, write_sources
from six_axis_documents import six_axis_document
from six_axis_ranges import NOISE, POSE_NOISE

PERIOD, RUN = 1e-3, 120  # s
POSE = np.array([0.05, -0.03, 0.5, 0.02, -0.01, 0.03])  # rad [m]; pose before a contact


def white(rng, ticks, force, torque):
    return rng.standard_normal((ticks, 6)) * np.repeat([force, torque], 3)


def noisy_rows(rng):
    """Return the rows of a run in which the model stands still, with noise of wrench and pose."""
    ticks = round(RUN / PERIOD) + 1
    wrench = white(rng, ticks, NOISE["force"], NOISE["torque"])
    measured = POSE + white(rng, ticks, POSE_NOISE["translation"], POSE_NOISE["rotation"])
    desired = np.broadcast_to(POSE, measured.shape)
    return rows_of((wrench, desired, np.zeros_like(measured), measured), PERIOD)


@pytest.mark.slow
@pytest.mark.parametrize("hours", [0.2, 5])
def test_noise_causes_at_most_one_false_onset_per_hour_in_six_axis_ledger(hours):
    noise = {"force_noise": NOISE["force"], "torque_noise": NOISE["torque"], "pose_filter": 3e-3}
    document = six_axis_document(limits={}, **noise)
    rng, onsets, ticks = np.random.default_rng(6), 0, 0
    with tempfile.TemporaryDirectory() as folder:
        sources = write_sources(Path(folder) / "noise", document)
        controller = SixAxisBatch(compiled(sources, DRIVER.name, "driver.so", "-O2", "-shared", "-fPIC"))
        while ticks * PERIOD < 3600 * hours:
            results = controller.run(noisy_rows(rng))
            acts = np.any(results[:, :6] != 0, axis=1)
            onsets += np.count_nonzero(acts[1:] & ~acts[:-1]) + acts[0]
            ticks += len(results)
    print(f"{onsets} false onsets in {ticks * PERIOD / 3600:.2f} h")
    assert onsets <= hours
