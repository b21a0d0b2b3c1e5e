"""Built-in six-axis mechanisms with the wide ranges on which their compensators are evaluated."""

from pathlib import Path

from jaxhil.mechanism.file import load_any

WIDE = Path(__file__).parent / "data" / "wide_ranges"  # built-in mechanisms with wide ranges and noise

OFFSETS = {"ring-capture": 0.01, "probe-drogue": 0.05}  # with larger offsets the ring misses the hooks [m]
ATTITUDES = {"ring-capture": 0.005, "hydraulic-hexapod": 0.015}  # rad
NOISE = {"force": 0.5, "torque": 0.05}  # N m [N]
POSE_NOISE = {"translation": 5e-6, "rotation": 1e-5}  # rad [m]


def load_wide(name):
    """Return a built-in mechanism with the ranges and noise of its file in `WIDE`."""
    return load_any(WIDE / f"{name}.toml").mechanism


def uniform(size, middle=0.0, **more):
    return {"distribution": "uniform", "low": middle - size, "high": middle + size, **more}


def with_ranges(name, pose_noise=None, **overrides):
    """Return a built-in mechanism: stiffness x 0.3 to 3, friction 0 to 0.2, force delay +- 0.3 ms, noise."""
    mechanism = load_any(name).mechanism
    delay = mechanism.rig.force_sensor.delay
    uncertain = {
        "approach.offset": uniform(OFFSETS.get(name, 0.03), independent=True),
        "approach.attitude": uniform(ATTITUDES.get(name, 0.03), independent=True),
        "rig.force_sensor.delay": uniform(3e-4, delay),
    }
    for contact in mechanism.contact:
        uncertain[f"contact.{contact}.stiffness"] = {"distribution": "loguniform", "factor": [0.3, 3.0]}
        uncertain[f"contact.{contact}.friction.coefficient"] = uniform(0.1, 0.1)
    if "rig.simulator.natural_frequency" in mechanism.uncertainty:
        legs = {"independent": True} if name == "hydraulic-hexapod" else {}
        frequency = {"distribution": "uniform", "factor": [0.85, 1.15], **legs}
        uncertain["rig.simulator.natural_frequency"] = frequency
    changes = {"uncertainty": uncertain, "rig.force_sensor.noise_std": NOISE}
    if pose_noise is not None:
        changes["rig.position_sensor.noise_std"] = pose_noise
    return load_any(name, changes | overrides).mechanism
