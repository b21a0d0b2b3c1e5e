"""Staged fit compared with a joint fit of all runs.

Both fits profile the likelihood of the force delay, so the Cramer-Rao bounds of the others depend on it.
`pytest -m "slow or not slow" -s tests/test_identify_stages.py` prints the bounds.
"""

import campaigns
import numpy as np
import pytest

from tuning.identification import free_motion
from tuning.identification.motion import MotionResponse
from tuning.identification.rational import STRUCTURES, MotionModel

NAMES = (
    "frequency",
    "damping ratio",
    "delay of motion",
    "delay of force",
    "plane",
    "stiffness",
    "damping",
    "bias",
)
TRUE = np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043, 0.0037, 0.0, 1.2e5, 650.0, 0.0])
STEPS = np.array([1e-5, 1e-5, 1e-7, 1e-7, 1e-8, 1.0, 0.1, 0.01])
MOTION, PROFILED = slice(0, 3), 3


def readings(runs, timing, numbers, noise, touching=None):
    """Return positions and forces of the contacts divided by their noise, and the rows in contact."""
    motion = MotionResponse(MotionModel(STRUCTURES[2], numbers[MOTION]), runs, timing, 0.022)
    position, velocity = motion.at(numbers[3])
    force = numbers[5] * (position - numbers[4]) + numbers[6] * velocity
    if touching is None:
        touching = (position > numbers[4]) & (force > 0.0)
    force = np.where(touching, force, 0.0) + numbers[7]
    return np.concatenate([motion.at(0.0)[0].ravel() / 5e-6, force.ravel() / noise]), touching


OTHERS = (pytest.param(*kind, marks=pytest.mark.slow) for kind in (("noisy", 60.0), ("clean", 10.0)))


@pytest.mark.parametrize("name, seconds", (("clean", 60.0), *OTHERS))
def test_joint_identification_is_hardly_more_precise_than_staged_identification(name, seconds):
    kind = campaigns.KINDS[name]
    campaign = campaigns.campaign(name, 0, speeds=(), seconds=seconds, rest=0)
    timing, noise = campaign.timing, kind.rig["force_sensor"]["noise_std"]
    free = np.zeros((8, 8))
    free[MOTION, MOTION] = np.linalg.inv(
        free_motion.fit_free_motion(list(campaign.runs), timing, 2).covariance
    )
    runs = campaigns._touch_runs(kind, np.random.default_rng(0), campaigns.SPEEDS)
    touching = readings(runs, timing, TRUE, noise)[1]
    slopes = np.array([
        (readings(runs, timing, TRUE + step, noise, touching)[0]
         - readings(runs, timing, TRUE - step, noise, touching)[0]) / (2.0 * step.sum())
        for step in np.diag(STEPS)
    ])  # fmt: skip
    free_indices = np.delete(np.arange(8), PROFILED)
    together = np.zeros(8)
    together[free_indices] = np.sqrt(
        np.diag(np.linalg.inv((slopes @ slopes.T + free)[np.ix_(free_indices, free_indices)]))
    )
    # Stage by stage: the motion from free runs alone, then the contact from the force with that motion fixed.
    force = slopes[:, slopes.shape[1] // 2 :]
    information, contact = force @ force.T, free_indices[3:]
    contact_covariance = np.linalg.inv(information[np.ix_(contact, contact)])
    moved = contact_covariance @ information[contact, MOTION]
    motion = np.linalg.inv(free[MOTION, MOTION])
    staged = np.zeros(8)
    staged[MOTION] = np.sqrt(np.diag(motion))
    staged[contact] = np.sqrt(np.diag(contact_covariance + moved @ motion @ moved.T))
    ratio = staged[free_indices] / together[free_indices]
    print(
        f"\n{name}, {seconds:g} s of free motion: standard deviations stage by stage over those all at once:"
    )
    print(", ".join(f"{NAMES[i]} {value:.3f}" for i, value in zip(free_indices, ratio, strict=True)))
    assert np.all(ratio > 0.999) and np.all(ratio < (1.05 if seconds == 60.0 else 1.2))
