"""The gains of the retrospective references: their bounds, and the two settings that are shipped."""

from collections.abc import Callable

from jaxhil.compensators.base import Gain, Gains, rig_gain
from jaxhil.compensators.estimates import (
    contact_plane_spread,
    force_bias,
    force_delay,
    friction,
    peak_force,
    preload,
)
from jaxhil.compensators.force_depth_map import Map, prior
from jaxhil.mechanism.structs import Mechanism

# Two sets of gains for any mechanism, each judged on linear, damped, Hertzian, hardening and layered contact
# of 1.5 to 5 Hz at once. Sharp, the nominal one, was found by CMA-ES with errors under other dissipation, of
# contact of 5 to 10 Hz and with the published rig's noise and dead zone in its objective; its repayment time
# by hand: contact that has many ticks left need not be hurried. Gentle may add less to the force that
# the map predicts; below 0.7 single contacts behind a dead zone err by 10 %.
SHARP = {
    "prior_stiffness": 9.563,
    "prior_stiffness_spread": 35.8,
    "prior_slope_spread": 29.17,
    "prior_damping_spread": 1.912,
    "prior_depth_damping_spread": 0.03103,
    "prior_unloading_spread": 0.1607,
    "force_noise_floor": 0.01091,
    "velocity_gain": 174.6,
    "repayment_time": 0.02,
    "correction_limit": 0.9,
    "replay_noise": 0.7679,
}
GENTLE = SHARP | {"correction_limit": 0.7}
USUAL_PRELOAD = 1.0  # 1/s
LEAST_PLANE_SPREAD, MOST_PLANE_SPREAD = 1e-6, 0.1  # m


def map_prior(gains: Gains) -> Map:
    """The map before the first reading of a contact, of the gains called `prior_...`."""
    return prior(
        stiffness=gains["prior_stiffness"],
        common=gains["prior_stiffness_spread"],
        wandering=gains["prior_slope_spread"],
        damping=gains["prior_damping_spread"],
        depth_damping=gains["prior_depth_damping_spread"],
        unloading=gains["prior_unloading_spread"],
        friction=gains["prior_friction_spread"],
        preload=gains["prior_preload_spread"],
    )


def _fact(mechanism) -> bool:
    """Of gains that are known beforehand or chosen, not tuned."""
    return False


def _prior(
    name: str, lower: float, upper: float, tuned: Callable[[Mechanism], bool] = lambda m: True
) -> Gain:
    """A gain that no mechanism's numbers enter: what it scales is scaled by approach speed and mass."""
    return rig_gain(
        name, lambda m: lower, lambda m: upper, lambda m: SHARP[name], logarithmic=True, tuned=tuned
    )


def _shows(*laws: str) -> Callable[[Mechanism], bool]:
    """Of what only such contacts show: on others it would be tuned away."""
    return lambda m: m.contact.law in laws


GAINS: tuple[Gain, ...] = (
    rig_gain(
        "equivalent_mass", lambda m: 0.1 * m.bodies.mass, lambda m: 10 * m.bodies.mass,
        lambda m: m.bodies.mass, logarithmic=True, tuned=_fact,
    ),
    rig_gain(
        "identification_delay", lambda m: 0.0, lambda m: 2 * force_delay(m) + 0.02,
        force_delay, tuned=_fact,
    ),
    rig_gain(
        "force_noise", lambda m: 0.0, lambda m: m.rig.force_sensor.noise_std + peak_force(m),
        lambda m: m.rig.force_sensor.noise_std, tuned=_fact,
    ),
    rig_gain(
        "dead_zone", lambda m: 0.0, lambda m: 2 * m.rig.force_sensor.dead_zone + peak_force(m),
        lambda m: m.rig.force_sensor.dead_zone, tuned=_fact,
    ),
    rig_gain("bias_spread", lambda m: 0.0, lambda m: force_bias(m) + peak_force(m), force_bias, tuned=_fact),
    rig_gain(
        "plane_spread", lambda m: LEAST_PLANE_SPREAD, lambda m: MOST_PLANE_SPREAD,
        lambda m: min(max(contact_plane_spread(m), LEAST_PLANE_SPREAD), MOST_PLANE_SPREAD), tuned=_fact,
    ),
    # Next to its spread it hardly matters.
    _prior("prior_stiffness", 0.1, 1e3, _fact),
    _prior("prior_stiffness_spread", 1.0, 5e3),
    _prior("prior_slope_spread", 0.1, 5e3),
    _prior("prior_damping_spread", 0.01, 50.0),
    _prior("prior_depth_damping_spread", 1e-4, 50.0, _shows("hunt_crossley", "depth_damped")),
    _prior("prior_unloading_spread", 1e-4, 5e3, _shows("elastoplastic")),
    # Off where there is none: damping and friction are hard to tell apart.
    rig_gain("prior_friction_spread", lambda m: 0.0, lambda m: 50.0 + friction(m), friction, tuned=_fact),
    rig_gain(
        "prior_preload_spread", lambda m: 0.0, lambda m: 50.0 + preload(m),
        lambda m: max(USUAL_PRELOAD, preload(m)), tuned=_fact,
    ),
    # Where there is noise, which is given and seen, it hardly matters.
    _prior("force_noise_floor", 1e-4, 10.0, lambda m: not m.rig.force_sensor.noise_std),
    rig_gain(
        "velocity_gain", lambda m: 1.0, lambda m: 1 / m.rig.control_period,
        lambda m: min(SHARP["velocity_gain"], 0.7 / m.rig.control_period), logarithmic=True,
    ),
    # A choice: of less force, or of less error.
    rig_gain(
        "repayment_time", lambda m: 0.0, lambda m: 10.0, lambda m: SHARP["repayment_time"], tuned=_fact,
    ),
    # Where the limit does not bind, no derivative tells of the force that it could spare.
    rig_gain(
        "correction_limit", lambda m: 0.01, lambda m: 20.0, lambda m: SHARP["correction_limit"],
        logarithmic=True, begins=lambda m: 1.0,
    ),
    # Neither is tuned: what is replayed is what makes it a test of the hardware, whatever that errs by.
    rig_gain("force_replay", lambda m: 0.0, lambda m: 1.0, lambda m: 1.0, tuned=_fact),
    _prior("replay_noise", 0.01, 100.0, _fact),
)  # fmt: skip
