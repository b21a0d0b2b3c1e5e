"""Complete table of a mechanism for tests of its keys, and functions to change it."""

import copy

import pytest

from jaxhil.errors import InputError
from jaxhil.mechanism.file import MAX_PROBLEMS, from_plain_data, load

# Every key of the schema, except keys of other laws and models, and keys that exclude each other.
FULL = {
    "schema": "jaxhil/mechanism/1",
    "name": "full",
    "source": "assumed",
    "bodies": {"equivalent_mass": 350.0},
    "approach": {"velocity": 0.005, "contacts": 3, "phase": 0.25},
    "contact": {
        "law": "kelvin_voigt",
        "stiffness": [124355.0, 373065.0],
        "damping": [100.0],
        "tension": False,
        "clearance": 0.02,
        "exponent": 1.5,
    },
    "rig": {
        "control_period": 0.001,
        "integrator": "zoh",
        "command_latency": 1,
        "command_hold": "zoh",
        "simulator": {
            "model": "second_order",
            "natural_frequency": 12.0,
            "damping_ratio": 0.8,
            "delay": 0.004,
            "velocity_limit": 0.5,
            "acceleration_limit": 2.0,
        },
        "force_sensor": {
            "delay": 0.008,
            "noise_std": 2.0,
            "quantum": 0.1,
            "dead_zone": 1.0,
            "bias": -1.0,
            "bias_random_walk": 0.5,
            "range": 1000.0,
            "loss_probability": 0.01,
            "filter": {"kind": "bessel", "order": 3, "cutoff": 200.0},
        },
        "position_sensor": {"delay": 0.001, "noise_std": 1e-6, "quantum": 1e-6},
        "contact_plane": 2e-5,
    },
    "uncertainty": {
        "contact.stiffness": {"distribution": "loguniform", "factor": [0.3, 3.0]},
        "rig.simulator.natural_frequency": {"distribution": "uniform", "low": 10.0, "high": 14.0},
        "rig.force_sensor.delay": {"distribution": "normal", "std": 0.0005, "independent": True},
    },
}


# Motion simulator models: each with its own keys, without those of the other models.
SECOND_ORDER = {"rig.simulator.natural_frequency": 12.0, "rig.simulator.damping_ratio": 0.8}
_OTHERS = {"uncertainty": {}, **dict.fromkeys(SECOND_ORDER, ...)}
IDEAL = {"rig.simulator.model": "ideal", **_OTHERS}
FIRST_ORDER = {"rig.simulator.model": "first_order", "rig.simulator.time_constant": 0.01, **_OTHERS}
THIRD_ORDER = {
    "rig.simulator.model": "third_order",
    "rig.simulator.coefficients": [0.1, 0.1, 0.001],
    **_OTHERS,
}
TRANSFER_FUNCTION = {
    "rig.simulator.model": "transfer_function",
    "rig.simulator.numerator": [1.0],
    "rig.simulator.denominator": [1.0, 1.0],
    **_OTHERS,
}
LAYERED = {
    "contact.law": "piecewise_linear",
    "contact.tension": False,
    "contact.depths": [0.001, 0.002],
    "contact.stiffness": [[1e5, 2e5, 3e5]],
}

# Keys of other laws and models, with valid values; the law and model of the full table do not allow them.
OF_OTHERS = {
    "contact.depths": [0.001, 0.002],
    "contact.reference_depth": 2e-4,
    "contact.unloading_ratio": 2.0,
    "contact.preload": 2.0,
    "contact.friction": 2.0,
    "rig.simulator.time_constant": 0.01,
    "rig.simulator.window": 0.01,
    "rig.force_sensor.time_constant": 0.001,
    "rig.simulator.coefficients": [0.1, 0.1, 0.001],
    "rig.simulator.numerator": [1.0],
    "rig.simulator.denominator": [1.0, 1.0],
}
# Keys that exclude a filter or a clearance, which the full table has.
EXCLUDED = ("rig.force_sensor.jitter", "rig.missed_tick_probability")


def changed(changes=(), base=FULL):
    """Return a copy of the full table with values at dotted paths replaced; `...` removes a key."""
    raw = copy.deepcopy(base)
    for path, value in dict(changes).items():
        *tables, key = path.split(".")
        node = raw
        for table in tables:
            node = node.setdefault(table, {})
        if value is ...:
            del node[key]
        else:
            node[key] = value
    return raw


def refusal(raw):
    """Return the message for a rejected table after checking that it is one line that names the source."""
    with pytest.raises(InputError) as caught:
        from_plain_data(raw, "some file")
    message = str(caught.value)
    assert message.isprintable() and message.startswith("some file: ") and len(message) < 500
    return message


def leaves(node=FULL, path=""):
    for key, value in node.items():
        if isinstance(value, dict) and key != "uncertainty":
            yield from leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}"


def tables(node=FULL, path=""):
    yield path
    for key, value in node.items():
        if isinstance(value, dict) and key != "uncertainty":
            yield from tables(value, f"{path}{key}.")


def file_refusal(path, overrides=(), unset=()):
    """Check that the message for an invalid file has a printable line for each key; return the message."""
    with pytest.raises(InputError) as caught:
        load(path, overrides, unset)
    message = str(caught.value)
    lines = message.split("\n")
    assert all(line.isprintable() and len(line) < 700 for line in lines) and len(lines) <= MAX_PROBLEMS
    assert len(set(lines)) == len(lines) and len({line.split(": ")[0] for line in lines}) == 1
    return message
