"""State of the impulse ledger in six axes in JAX; vectors have the shape (6, *batch)."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.six_axes.tangent_model.simulation import Estimate
from jaxhil.laws.simulation_base import Gains
from jaxhil.laws.six_axis_base import Six, SixAxisConstants

# Rows of the ring: measured pose; pose, twist and impulse of the model.
POSE, MODEL = slice(0, 6), slice(6, 24)


class PreparedLedger(NamedTuple):
    """Gains and constants of the six-axis impulse ledger, computed once per run."""

    gains: Gains
    constants: SixAxisConstants
    pole: Float[Array, "*batch"]  # pole of the pose filter [1]
    back: Float[Array, "*batch"]  # age of the force reading minus the lag of the pose filter [ticks]
    prior: Estimate  # prior of the tangent model
    noise_metric: Float[Array, "6 6 *batch"]  # A^T M^-1 A, with which |A W|^2 is a quadratic form of W


class FreeFlightState(NamedTuple):
    """Means of readings and motion in free flight."""

    bias: Six  # mean of the wrench readings [N, N m]
    readings: Float[Array, "*batch"]  # number of readings in `bias`
    lag: Six  # mean of the model's pose minus the hardware's delayed pose (`Reading.pose`) [m, rad]
    twist: Six  # mean twist of the model [m/s, rad/s]
    ticks: Float[Array, "*batch"]  # number of ticks in `lag` and `twist`
    ticks_since_contact: Float[Array, "*batch"]  # large before the first contact


class SixAxisContact(NamedTuple):
    """State of the six-axis impulse ledger during one contact."""

    delay: Float[Array, "*batch"]  # D, delay of the loop [ticks]
    speed: Float[Array, "*batch"]  # v_0, approach speed along the contact's direction
    impulse: Six  # I_r, impulse of the reference up to t - D [N s, N m s]
    drift: Six  # eps, pose of the model at t - D minus the reference's pose [m, rad]
    direction: Six  # filtered wrench; a pulling force does not reverse it [N, N m]
    modelled: Six  # contact's direction when the tangent model was last restarted
    path: Float[Array, "*batch"]  # X, depth of the hardware along the direction since the onset
    peak: Float[Array, "*batch"]  # largest force so far, per unit mass
    tool: Float[Array, "*batch"]  # largest |W|^2 so far of the tool's inertia force


class LedgerState(NamedTuple):
    """State of the six-axis impulse ledger after a tick."""

    ring: Float[Array, "samples 24 *batch"]  # hardware's filtered pose; model's pose, twist and impulse
    filtered: Six  # filtered pose of the hardware [m, rad]
    first: Six  # filtered pose of the hardware on the run's first tick [m, rad]
    aligned: Six  # filtered pose of the hardware, delayed like the force [m, rad]
    impulse: Six  # I_c, impulse commanded so far [N s, N m s]
    flight: FreeFlightState
    in_contact: Bool[Array, "*batch"]
    contact: SixAxisContact
    estimate: Estimate


class Reading(NamedTuple):
    """Sensor readings of one tick, corrected and aligned."""

    wrench: Six  # W, wrench of the contact about the origin of frame C [N, N m]
    variance: Float[Array, "*batch"]  # mean of |W|^2 if W is only noise
    pose: Six  # xi_a, pose of the hardware, delayed like the force [m, rad]
    twist: Six  # rate of `pose` [m/s, rad/s]
    pose_change: Six  # change of `pose` since the last tick [m, rad]
    is_contact: Bool[Array, "*batch"]  # whether the wrench is large enough for a contact
