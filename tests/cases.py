"""Registry of mechanisms and gains that cover every branch of the simulation loop, and functions to run them.

Cases whose compiled loop has the same form share one program, as lanes of one batch (`batches`). Therefore
each case also tests that unused optional parts of the loop have no effect, and that lanes are independent.
`oracle_contacts` runs the same case in the independent oracle with the Python compensator of the rig.
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from lanes import (
    IDEAL,
    MASS,
    PERIOD,
    SECOND_ORDER,
    STIFFNESS,
    join,
    mechanism,
    nominal_gains,
    run_rollout,
    validated,
)
from oracle import simulate

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.laws.shared.nominal_values import force_delay
from jaxhil.rig import COMPENSATORS as RIG_COMPENSATORS
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.scenario import Scenario, build_scenarios


class Case(NamedTuple):
    """Mechanism (parsed file), compensator, and gains that differ from their nominal values."""

    mechanism: dict[str, Any]
    compensator: str = "none"
    gains: Mapping[str, float] = {}


class Batch(NamedTuple):
    """Cases that share one program: names in the order of the lanes, loop, gains and scenarios."""

    names: tuple[str, ...]
    loop: Loop
    gains: dict[str, jax.Array]
    scenario: Scenario

    def run(self) -> Metrics:
        """Run all cases, and return their metrics (slots, lanes) as NumPy arrays."""
        return jax.tree.map(np.asarray, run_rollout(self.loop, self.gains, self.scenario))


def build_batch(cases: Mapping[str, Case]) -> Batch:
    """Return one batch of cases whose loops have the same form."""
    compensator = next(iter(cases.values())).compensator
    mechanisms = {name: validated(case.mechanism) for name, case in cases.items()}
    scenario = join(build_scenarios(m) for m in mechanisms.values())
    gains = [nominal_gains(m, compensator, **cases[name].gains) for name, m in mechanisms.items()]
    # The delay line of the controller must cover the delays of every lane.
    longest = max(mechanisms.values(), key=force_delay)
    return Batch(
        tuple(cases),
        build_loop(longest, compensator, scenario, energies=True, chatter=True),
        {name: np.array([lane[name] for lane in gains]) for name in gains[0]},
        scenario,
    )


def form(case: Case) -> tuple[Any, ...]:
    """Return the properties that determine the compiled loop; cases with equal form may share a batch."""
    parsed = validated(case.mechanism)
    contact, rig = parsed.contact, parsed.rig
    simulator = rig.simulator.model, len(rig.simulator.denominator or ())
    if simulator[0] == "third_order":
        simulator = "transfer_function", 4
    return (
        *(case.compensator, CONTACT_LAWS[contact.law], len(contact.depths), np.isfinite(contact.clearance)),
        *(simulator, rig.integrator, rig.command_hold, rig.command_latency, rig.force_sensor.dead_zone_kind),
    )


@functools.cache
def batches() -> dict[str, Batch]:
    """Return the batch of each case of the registry, by name of the case."""
    groups: dict[Any, dict[str, Case]] = {}
    for name, case in CASES.items():
        groups.setdefault(form(case), {})[name] = case
    # All batches have the same number of lanes, so that the computations before the loop are compiled once.
    width = max(len(group) for group in groups.values())
    for group in groups.values():
        first = next(iter(group.values()))
        group.update({f"copy {i}": first for i in range(len(group), width)})
    built = [build_batch(group) for group in groups.values()]
    return {name: batch for batch in built for name in batch.names}


@functools.cache
def _metrics(names: tuple[str, ...]) -> Metrics:
    return batches()[names[0]].run()


def loop_contacts(name: str) -> list[dict[str, float]]:
    """Return the simulated metrics of each contact of a case, by field of `Metrics`."""
    names = batches()[name].names
    metrics, lane = _metrics(names), names.index(name)
    contacts = CASES[name].mechanism["approach"]["contacts"]
    return [{k: v[i, lane].item() for k, v in metrics._asdict().items()} for i in range(contacts)]


@functools.cache
def oracle_contacts(name: str) -> list[dict[str, Any]]:
    """Return the oracle's results for each contact of a case."""
    return run_oracle(CASES[name])


def run_oracle(case: Case, **options: Any) -> list[dict[str, Any]]:
    """Return the oracle's contacts of a case under the compensator of the rig."""
    parsed = validated(case.mechanism)
    gains = nominal_gains(parsed, case.compensator, **case.gains)
    compensator = RIG_COMPENSATORS[case.compensator](
        gains, parsed.rig.control_period, parsed.contact.clearance
    )
    return simulate(case.mechanism, compensator, **options)


def damping(ratio: float, stiffness: float = STIFFNESS) -> list[float]:
    return [2 * ratio * (stiffness * MASS) ** 0.5]


LIST = {"stiffness": [STIFFNESS, 3 * STIFFNESS, 0.5 * STIFFNESS], "damping": [500.0, 100.0]}
LAYERS = {
    "law": "piecewise_linear",
    "depths": [1e-4, 2e-4],
    "stiffness": [[8e4, 1.6e5, 3.2e5], [6e4, 1.2e5, 4e5]],
}
HERTZ = {"law": "hunt_crossley", "stiffness": [1e7, 2e7]}
HARDENING = {"law": "hardening", "stiffness": [STIFFNESS, 0.4 * STIFFNESS], "reference_depth": 5e-4}
DEPTH_DAMPED = {"law": "depth_damped", "stiffness": [1e7, 2e7], "reference_depth": 2e-4}
PRELOADED = {"law": "preloaded", "stiffness": [STIFFNESS, 2 * STIFFNESS], "preload": 7.0, "friction": 3.0}
ELASTOPLASTIC = {"law": "elastoplastic", "stiffness": [STIFFNESS, 2 * STIFFNESS], "unloading_ratio": 1.6}
FIRST_ORDER = {"model": "first_order", "time_constant": 0.009, "delay": 0.0013}
THIRD_ORDER = {"model": "third_order", "coefficients": [0.02, 1.6e-4, 5e-7], "delay": 0.0029}
TRANSFER = {"model": "transfer_function", "numerator": [0.004, 1.0], "denominator": [4e-7, 1.5e-4, 0.02, 1.0]}
RATTLING = {"model": "second_order", "natural_frequency": 25.0, "damping_ratio": 0.8, "delay": 0.0021}
LATE_EULER = {"command_latency": 1, "integrator": "explicit_euler"}
ALL_ZOH = {"command_hold": "zoh", "integrator": "zoh"}
# Gains that reduce response-error compensation to its phase lead.
LEAD_ALONE = {"response_error": 0.0, "response_error_damping": 0.0}
LAGGED = {"force_sensor": {"time_constant": 0.0023}}

CASES: dict[str, Case] = {
    # Cases without compensator: Kelvin-Voigt and linear contact with a second-order simulator.
    "linear": Case(mechanism({"law": "linear", "damping": [900.0]})),
    "delays of whole periods": Case(
        mechanism({"damping": [300.0]}, {**SECOND_ORDER, "delay": 2 * PERIOD}, 3 * PERIOD)
    ),
    "no delays": Case(mechanism({"damping": [300.0]}, {**SECOND_ORDER, "delay": 0.0}, 0.0)),
    "delays that make a whole period together": Case(
        mechanism({}, {**SECOND_ORDER, "delay": 0.0013}, 2 * PERIOD - 0.0013)
    ),
    "a list of stiffness and damping": Case(mechanism(LIST, contacts=3)),
    "heavy damping": Case(mechanism({"damping": damping(0.4)})),
    "tension": Case(mechanism({"damping": damping(0.3), "tension": True})),
    "overdamped": Case(mechanism({"damping": damping(1.3)})),
    "two masses": Case(
        mechanism({"damping": [200.0]}) | {"bodies": {"chaser_mass": 500.0, "target_mass": 900.0}}
    ),
    # Cases with other integrators, holds, latencies and motion simulators.
    "zoh hold and integrator": Case(
        mechanism(LIST, contacts=2, command_hold="zoh", integrator="zoh"), "phase_lead"
    ),
    "transfer function with latency": Case(mechanism(LIST, TRANSFER, contacts=2, **LATE_EULER)),
    "third order with latency": Case(mechanism(LIST, THIRD_ORDER, **LATE_EULER)),
    "first order": Case(mechanism({"damping": [300.0]}, FIRST_ORDER), "phase_lead"),
    # Cases with the ideal motion simulator.
    "ideal": Case(mechanism(LIST, IDEAL, contacts=2), "phase_lead"),
    "ideal with transport delay": Case(mechanism(LIST, {**IDEAL, "delay": 0.0033}), "phase_lead"),
    "ideal without delay": Case(mechanism({"damping": [300.0]}, IDEAL, 0.0), "phase_lead", {"phase_lead": 0}),
    "ideal with zoh hold": Case(
        mechanism({"stiffness": [STIFFNESS, 3e5]}, IDEAL, contacts=2, command_hold="zoh", command_latency=1)
    ),
    # Cases with other contact laws, some of them with response-error compensation.
    "hertz": Case(mechanism(HERTZ, FIRST_ORDER, contacts=2, **ALL_ZOH), "response_error"),
    "hunt-crossley": Case(
        mechanism({**HERTZ, "damping": [20.0]}, FIRST_ORDER, **ALL_ZOH),
        "response_error",
        {"initial_stiffness": 2e5},
    ),
    "quadratic hunt-crossley": Case(
        mechanism({**HERTZ, "exponent": 2.0, "stiffness": [4e8], "damping": [5.0]}, FIRST_ORDER, **ALL_ZOH),
        "response_error",
    ),
    "layers": Case(mechanism(LAYERS, THIRD_ORDER, contacts=2, command_hold="zoh"), "response_error"),
    "damped layers": Case(
        mechanism({**LAYERS, "damping": [400.0]}, TRANSFER, command_hold="zoh"), "response_error"
    ),
    "hardening": Case(mechanism(HARDENING, contacts=2), "phase_lead"),
    "damped hardening": Case(
        mechanism({**HARDENING, "stiffness": [0.3 * STIFFNESS], "damping": [700.0]}, **LAGGED), "phase_lead"
    ),
    "depth-damped": Case(mechanism({**DEPTH_DAMPED, "damping": [900.0]}, contacts=2), "phase_lead"),
    "depth-damped, linear spring, lag": Case(
        mechanism(
            {**DEPTH_DAMPED, "stiffness": [STIFFNESS], "exponent": 1.0, "damping": [600.0]}, **LAGGED
        ),
        "phase_lead",
    ),
    "elastoplastic": Case(mechanism(ELASTOPLASTIC, contacts=2), "phase_lead"),
    "elastoplastic, lag": Case(mechanism({**ELASTOPLASTIC, "unloading_ratio": 3.0}, **LAGGED), "phase_lead"),
    "rattling, elastoplastic": Case(
        mechanism({**ELASTOPLASTIC, "clearance": 0.002}, RATTLING, 0.003, 3, velocity=0.01), "phase_lead"
    ),
    "preloaded": Case(mechanism(PRELOADED, contacts=2), "phase_lead"),
    "more friction than preload": Case(mechanism({**PRELOADED, "preload": 1.0}), "phase_lead"),
    # Cases of response error and position lead, with sensor errors and limits of the motion simulator.
    "response error": Case(mechanism(LIST, contacts=3), "response_error"),
    "response error, gains off nominal": Case(
        mechanism({"damping": [300.0]}, contacts=2),
        "response_error",
        {
            **{"phase_lead": 0.006, "lead_filter": 0.0031, "response_error": 0.8, "forgetting": 0.95},
            **{"response_error_damping": 0.6, "initial_stiffness": 9e4, "initial_damping": 120.0},
            **{"identification_delay": 0.0071, "velocity_filter": 0.0067, "contact_threshold": 12.0},
        },
    ),
    "late position": Case(mechanism(LIST, position_sensor={"delay": 0.0037}), "response_error"),
    "position a whole period late": Case(mechanism(LIST, position_sensor={"delay": 0.002}), "response_error"),
    "contact plane deeper": Case(
        mechanism({**LIST, "damping": [300.0]}, contacts=2, contact_plane=4.3e-5), "response_error"
    ),
    "dead zone": Case(mechanism(LIST, contacts=2, force_sensor={"dead_zone": 4.0}), "response_error"),
    "cut dead zone": Case(
        mechanism(LIST, contacts=2, force_sensor={"dead_zone": 4.0, "dead_zone_kind": "cut"}),
        "response_error",
    ),
    "quantum": Case(
        mechanism(LIST, force_sensor={"quantum": 0.5}, position_sensor={"quantum": 1e-7}), "response_error"
    ),
    "range": Case(mechanism(LIST, force_sensor={"range": 20.0, "dead_zone": 1.0}), "response_error"),
    "velocity limit": Case(
        mechanism(LIST, {**SECOND_ORDER, "velocity_limit": 0.00505}, 0.011, contacts=2), "response_error"
    ),
    "position lead": Case(mechanism(LIST, contacts=2), "position_lead"),
    "position lead, late drives with a limit": Case(
        mechanism(LIST, {**SECOND_ORDER, "velocity_limit": 0.007}, command_latency=1),
        "position_lead",
    ),
    # Cases whose force sensor has a lag.
    "lag": Case(mechanism({}, **LAGGED), "phase_lead"),
    "damped, lag": Case(mechanism({"damping": [500.0]}, **LAGGED), "phase_lead"),
    "damped, lag, 1 kHz": Case(mechanism({"damping": [500.0]}, period=1e-3, **LAGGED), "phase_lead"),
    "stiff, damped, lag": Case(
        mechanism({"stiffness": [3 * STIFFNESS], "damping": [1000.0]}, **LAGGED), "phase_lead"
    ),
    "no lag beside lagged ones": Case(mechanism({"damping": [500.0]}), "phase_lead"),
    # Cases with two contact surfaces.
    "rattling, lag": Case(
        mechanism(
            {**LIST, "damping": [120.0], "clearance": 0.002}, RATTLING, 0.003, 3, velocity=0.01, **LAGGED
        ),
        "response_error",
    ),
    "rattling, contact plane nearer": Case(
        mechanism(
            {**LIST, "damping": [120.0], "clearance": 0.002}, RATTLING, 0.003, 3, velocity=0.01,
            contact_plane=-7.7e-5, **LAGGED,
        ),
        "response_error",
    ),
    "elastoplastic, contact plane nearer": Case(
        mechanism({"law": "elastoplastic", "unloading_ratio": 1.5}, contact_plane=-3.1e-5), "phase_lead"
    ),
    "rattling": Case(
        mechanism({**LIST, "damping": [120.0], "clearance": 0.002}, RATTLING, 0.003, 3, velocity=0.01),
        "response_error",
    ),
    "rattling, faster than the drives at first": Case(
        mechanism(
            {"damping": [100.0, 3000.0, 500.0], "clearance": 0.002},
            {**RATTLING, "velocity_limit": 0.0102}, 0.003, 3, velocity=0.01,
        ),
        "response_error",
    ),
    "rattling with tension": Case(
        mechanism(
            {"damping": [400.0], "tension": True, "clearance": 0.0015}, RATTLING, 0.003, 2, velocity=0.01
        ),
        "response_error",
    ),
    "rattling against layers": Case(
        mechanism({**LAYERS, "damping": [150.0], "clearance": 0.001}, IDEAL, 0.003, 3, velocity=0.01)
    ),
    "rattling, the next touch at once": Case(
        mechanism(
            {"damping": [400.0], "clearance": 0.0004693103448275862}, RATTLING, 0.003, 2, velocity=0.01
        ),
        "response_error",
        LEAD_ALONE | {"phase_lead": 0.005, "lead_filter": 0.0027241379310344828},
    ),
    "rattling behind a long transport delay": Case(
        mechanism(
            {"stiffness": [STIFFNESS, STIFFNESS / 2], "damping": [400.0], "clearance": 0.0007},
            {**RATTLING, "delay": 0.015}, 0.003, 2, velocity=0.01,
        ),
        "response_error",
        LEAD_ALONE | {"phase_lead": 0.018, "lead_filter": 0.0026},
    ),
}  # fmt: skip
