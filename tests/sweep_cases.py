"""Small sweeps for tests: one contact at a coarse control period, with a few uncertain parameters."""

import math
from typing import Any

from cases import SECOND_ORDER, mechanism, nominal_gains, validated

from jaxhil.simulation.gain_file import check_document
from tuning.gain_file import build_document
from tuning.sweeps.manifest import Manifest, ManifestOptions, build_manifest

UNCERTAIN = {
    "contact.stiffness": {"distribution": "loguniform", "factor": [0.3, 3.0]},
    "rig.force_sensor.delay": {"distribution": "normal", "std": 0.0005},
}
NOISY = {"noise_std": 1.0}


def case(
    contacts: int = 1,
    compensator: str = "none",
    force_sensor: Any = None,
    uncertainty: Any = UNCERTAIN,
    correlation: Any = None,
    **simulator: float,
) -> dict[str, Any]:
    """Return a gain document for a mechanism with the given number of contacts."""
    raw = mechanism({}, {**SECOND_ORDER, **simulator}, contacts=contacts, force_sensor=force_sensor)
    parsed = validated({**raw, "uncertainty": uncertainty, "correlation": correlation})
    gains = nominal_gains(parsed, compensator)
    return build_document(compensator, gains, parsed, "0" * 64, {}, {}, 0, {})


def manifest(document: dict[str, Any] | None = None, scenarios: int = 100, **choices: Any) -> Manifest:
    """Return a sweep over `case()` in chunks of 32."""
    loaded = check_document(document or case())
    return build_manifest(loaded, ManifestOptions(scenarios, **{"chunk": 32, "limit": math.inf, **choices}))
