"""Valid gain documents for tests that read or write gain files."""

import copy
from typing import Any

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import from_plain_data
from jaxhil.rig import digest

MECHANISM: dict[str, Any] = {
    "schema": "jaxhil/mechanism/1",
    "name": "rig-350kg",
    "source": "assumed",
    "bodies": {"equivalent_mass": 350.0},
    "approach": {"velocity": 0.005, "contacts": 1, "phase": 0.3333333333333333},
    "contact": {
        "law": "kelvin_voigt",
        "stiffness": [124355.0],
        "damping": [0.0],
        "tension": False,
    },
    "rig": {
        "control_period": 0.001,
        "integrator": "semi_implicit_euler",
        "command_latency": 0,
        "command_hold": "linear",
        "simulator": {
            "model": "second_order",
            "natural_frequency": 12.0,
            "damping_ratio": 0.8,
            "delay": 0.004,
        },
        "force_sensor": {"delay": 0.008, "time_constant": 0.0, "noise_std": 0.0},
        "position_sensor": {"delay": 0.0, "noise_std": 0.0, "quantum": 0.0},
    },
}

_LEAD = {
    "phase_lead": {"value": 0.008, "unit": "s", "lower": 0.0, "upper": 0.05},
    "lead_filter": {"value": 0.001, "unit": "s", "lower": 1e-4, "upper": 0.02},
}


def _entries(compensator: str) -> dict[str, dict[str, Any]]:
    """Return gains at the literature's values, or well within their bounds if that value is 0."""
    mechanism = from_plain_data(copy.deepcopy(MECHANISM), "documents")
    entries = {}
    for gain in COMPENSATORS[compensator].gains:
        lower, upper = gain.lower(mechanism), gain.upper(mechanism)
        value = gain.nominal(mechanism) or 0.7 * lower + 0.3 * upper
        entries[gain.name] = {"value": value, "unit": gain.unit, "lower": lower, "upper": upper}
    return entries


GAINS: dict[str, dict[str, dict[str, Any]]] = {
    **{compensator: _entries(compensator) for compensator in COMPENSATORS},
    "phase_lead": _LEAD,
    "impulse_ledger": {
        **_entries("impulse_ledger"),
        # The delay is not a whole number of ticks, where no derivative exists.
        "identification_delay": {"value": 0.0083, "unit": "s", "lower": 0.0, "upper": 0.05},
        "velocity_gain": {"value": 10.0, "unit": "1/s", "lower": 1.0, "upper": 1e3},
        "correction_limit": {"value": 0.9, "unit": "1", "lower": 0.01, "upper": 20.0},
        "force_noise": {"value": 0.3, "unit": "N", "lower": 0.0, "upper": 100.0},
        "delay_spread": {"value": 0.0008, "unit": "s", "lower": 0.0, "upper": 0.004},
        "prior_friction_spread": {"value": 0.5, "unit": "1/s", "lower": 0.0, "upper": 50.0},
        "prior_preload_spread": {"value": 3.0, "unit": "1/s", "lower": 0.0, "upper": 50.0},
    },
    "response_error": {
        **_LEAD,
        "response_error": {"value": 0.9, "unit": "1", "lower": 0.0, "upper": 2.0},
        "response_error_damping": {"value": 0.7, "unit": "1", "lower": 0.0, "upper": 2.0},
        "initial_stiffness": {"value": 8e4, "unit": "N/m", "lower": 0.0, "upper": 1e7},
        "initial_damping": {"value": 50.0, "unit": "N s/m", "lower": 0.0, "upper": 1e5},
        "stiffness_covariance": {"value": 1e8, "unit": "1/m^2", "lower": 0.0, "upper": 1e12},
        "damping_covariance": {"value": 1e4, "unit": "s^2/m^2", "lower": 0.0, "upper": 1e12},
        "forgetting": {"value": 0.995, "unit": "1", "lower": 0.9, "upper": 1.0},
        "contact_threshold": {"value": 5.0, "unit": "N", "lower": 0.0, "upper": 100.0},
        "identification_delay": {"value": 0.0083, "unit": "s", "lower": 0.0, "upper": 0.05},
        "velocity_filter": {"value": 0.004, "unit": "s", "lower": 0.0, "upper": 0.1},
    },
}


def sign(document: dict[str, Any]) -> dict[str, Any]:
    """Write the digest of the document's content into the document."""
    document["sha256"] = digest(document)
    return document


def gain_document(
    compensator: str = "response_error",
    *,
    control_period: float = 0.001,
    clearance: float | None = None,
    **values: float,
) -> dict[str, Any]:
    """Return a valid gain document; `values` replaces gain values, within the bounds of `GAINS`."""
    gains = copy.deepcopy(GAINS[compensator])
    for name, value in values.items():
        gains[name]["value"] = value
    mechanism = copy.deepcopy(MECHANISM)
    mechanism["rig"]["control_period"] = control_period
    if clearance is not None:
        mechanism["contact"]["clearance"] = clearance
    return sign(
        {
            "schema": "jaxhil/gains/1",
            "compensator": compensator,
            "gains": gains,
            "control_period": control_period,
            "mechanism": mechanism,
            "mechanism_sha256": "0" * 64,
            "envelope": {"contact_frequency": [1.0, 6.0], "approach_velocity": [0.002, 0.01]},
            "figures": {"nominal": {"before": 0.21, "after": 0.002}},
            "seed": 0,
            "versions": {"jaxhil": "0.1.0", "python": "3.11"},
            "created": "2000-01-01T00:00:00Z",
            "timings": {"tune_s": 12.5},
        }
    )
