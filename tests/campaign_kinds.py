"""Kinds of rigs for simulated campaigns with known true parameters, and their log settings."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Kind:
    """Rig and the settings of its log."""

    rig: dict[str, Any]
    contact: dict[str, Any]
    colour: float = 0.0  # pole of the noise filter
    jitter: float = 0.0  # jitter of the time stamps [s]
    lost: float = 0.0  # share of rows lost
    block: int = 0  # consecutive rows lost in the middle of the free motion
    amplitude: float = 0.0008  # rms of the multisine [m]
    drift: float = 0.0  # relative increase of the stiffness from first to last contact
    mass: float = 350.0


def rig(noise=0.5, position_noise=5e-6, **changes):
    rig = {
        "control_period": 0.001,
        "simulator": {
            "model": "second_order",
            "natural_frequency": 12.0,
            "damping_ratio": 0.8,
            "delay": 0.0043,
        },
        "force_sensor": {"delay": 0.0037, "noise_std": noise},
        "position_sensor": {"noise_std": position_noise},
    }
    for path, value in changes.items():
        target, *keys = path.split("__")
        if keys:
            rig[target] = {**rig.get(target, {}), keys[0]: value}
        else:
            rig[target] = value
    return rig


def voigt(stiffness=(1.2e5,), damping=(650.0,)):
    return {"law": "kelvin_voigt", "stiffness": list(stiffness), "damping": list(damping)}


THIRD = {"model": "third_order", "coefficients": [0.018, 1.6e-4, 7e-7], "delay": 0.0031}
# Two pole pairs; the second is a structural resonance with an antiresonance.
RESONANT = {
    "model": "transfer_function",
    "numerator": [1.0 / 235.0**2, 2 * 0.02 / 235.0, 1.0],
    "denominator": list(
        np.polymul([1.0 / 75.0**2, 2 * 0.8 / 75.0, 1.0], [1.0 / 220.0**2, 2 * 0.03 / 220.0, 1.0])
    ),
    "delay": 0.0043,
}
PUBLISHED = {"force_sensor__bias": 1.3, "force_sensor__quantum": 0.5, "position_sensor__quantum": 1e-6}
HERTZ = {"law": "hunt_crossley", "stiffness": [6e6], "damping": [2.0], "exponent": 1.5}

LAYERED = {
    "law": "piecewise_linear",
    "stiffness": [[8e4, 2.4e5]],
    "damping": [300.0],
    "depths": [0.0003],
}

KINDS = {
    "clean": Kind(rig(), voigt()),
    "noisy": Kind(rig(noise=2.67, **PUBLISHED), voigt()),
    "coloured": Kind(rig(), voigt(), colour=0.6),
    "jitter": Kind(rig(), voigt(), jitter=2e-4, lost=0.002, block=400),
    "dead_zone": Kind(rig(force_sensor__dead_zone=4.0), voigt()),
    "lagging": Kind(rig(force_sensor__time_constant=0.0016, position_sensor__delay=0.0012), voigt()),
    "third_order": Kind(rig(simulator=THIRD, command_hold="zoh", command_latency=1), voigt()),
    "resonance": Kind(rig(simulator=RESONANT), voigt()),
    "hertz": Kind(rig(), HERTZ),
    "layered": Kind(rig(), LAYERED),
    "stiffnesses": Kind(rig(contact_plane=2e-4), voigt((1.2e5, 2.4e5, 7e4))),
    "drifting": Kind(rig(), voigt(), drift=0.15),
}
