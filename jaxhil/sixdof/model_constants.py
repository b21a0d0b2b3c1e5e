"""Constants of the numerical model and the rig that a six-axis gain file contains."""

from typing import Any

import jax
import numpy as np

from jaxhil.laws.impulse_ledger.six_axes.constants import MAX_RECALL
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.rig.six_axes.registry import ModelConstants
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.controller_record import known_constants
from jaxhil.sixdof.vectors import components


def model_constants(mechanism: SixAxisMechanism) -> dict[str, Any]:
    """Compute the `ModelConstants` of a nominal mechanism; return its fields by name, as JSON data."""
    with jax_context():
        scenario = build_scenarios(mechanism)
        # The delay line of a compensator that reads the pose limits the delay.
        loop = make_loop(mechanism, "impulse_ledger", scenario)
        constants = jax.device_get(known_constants(loop, scenario))
    mass, inverse, correction = (
        np.asarray(matrix)[..., 0].tolist()
        for matrix in (constants.mass_matrix, constants.inverse_mass, constants.tool_correction)
    )
    sign, tool = (1.0, scenario.sensor.assumed_tool) if loop.side == "moving" else (-1.0, None)
    load = np.zeros(6)
    if tool is not None:
        weight = tool.mass[None] * components(scenario.sensor.assumed_gravity)
        load = np.concatenate([weight, components(tool.centre)])[:, 0]
    delay = min(loop.controller_ring - 2.0, MAX_RECALL) * mechanism.rig.control_period
    return ModelConstants(mass, inverse, correction, delay, sign, load.tolist())._asdict()
