"""Kinds of campaigns drawn at random: combinations of rigs, noise and logs that no fixed kind has."""

import numpy as np

UNKNOWN = ("contact.damping", "rig.force_sensor.time_constant", "rig.force_sensor.dead_zone",
           "rig.force_sensor.delay", "rig.simulator.delay")  # fmt: skip


def draw_mixture(seed):
    """Return the fields of a `Kind` whose rig the model of `identify` explains."""
    rng = np.random.default_rng([seed, 77])

    def happens(probability):
        return rng.random() < probability

    changes = _draw_rig(rng)
    if happens(0.4):
        changes |= {"filter_order": 1, "cutoff": 1 / (2 * np.pi * rng.uniform(0.0003, 0.003))}
    if happens(0.35):
        changes["dead_zone"] = rng.uniform(0.3, 8.0)
    if happens(0.3):
        changes["position_delay"] = rng.uniform(0.0, 0.003)
    fields = {
        "colour": rng.uniform(0.2, 4.0) if happens(0.3) else 0.0,
        "lost": rng.uniform(0.001, 0.03) if happens(0.3) else 0.0,
        "force_clock": happens(0.15),
        "late": int(rng.integers(1, 60)) if happens(0.15) else 0,
        "sweep": happens(0.3),
        "noiseless": happens(0.1),
        "unknown": tuple(key for key in UNKNOWN if happens(0.35)),
        "repeats": int(rng.choice([2, 3, 5, 8])),
        "free": float(rng.choice([20.0, 60.0])),
        "noise": (_log_uniform(rng, 0.02, 2.0), _log_uniform(rng, 2e-7, 1e-5)),
    }
    if fields["force_clock"]:
        fields["late"] = 0
    if happens(0.1):
        fields |= {"walk": rng.uniform(0.02, 1.0), "states_walk": True}
    return {"rig": lambda *_: changes, **fields}


def _draw_rig(rng):
    """Return fields of a rig with softer, stiffer, lighter and slower values than `draw_rig` draws."""
    mass, omega = _log_uniform(rng, 50, 2000), 2 * np.pi * rng.uniform(1, 6)
    ratio = rng.choice([0.0, rng.uniform(0, 0.09), rng.uniform(0, 0.3)], p=[0.15, 0.425, 0.425])
    return {
        "period": 1 / rng.choice([250, 500, 1000, 2000, 4000]),
        "mass": mass,
        "stiffness": mass * omega**2,
        "damping": 2 * ratio * mass * omega,
        "frequency": rng.uniform(5, 40),
        "ratio": rng.uniform(0.4, 1.2),
    }


def _log_uniform(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
