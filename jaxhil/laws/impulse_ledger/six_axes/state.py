"""State of the impulse ledger in six axes in JAX; vectors are (6, *batch)."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.six_axes.tangent_model.simulation import Estimate
from jaxhil.laws.simulation_base import Gains
from jaxhil.laws.six_axis_base import Six, SixAxisConstants

POSE, DESIRED, TWIST, IMPULSE = (slice(6 * part, 6 * part + 6) for part in range(4))  # rows of the ring


class Prepared(NamedTuple):
    """Gains and constants, computed once per run."""

    gains: Gains
    constants: SixAxisConstants
    pole: Float[Array, "*batch"]  # of the pose filter [1]
    back: Float[Array, "*batch"]  # age of the force reading less the filter's lag [ticks]
    prior: Estimate  # of the tangent model


class FreeFlightState(NamedTuple):
    """Means over free flight."""

    bias: Six  # of the readings
    readings: Float[Array, "*batch"]  # number of readings in it
    lag: Six  # pose of the model minus that of the hardware, as old as the reading
    twist: Six  # of the model
    ticks: Float[Array, "*batch"]  # number of ticks in both
    quiet: Float[Array, "*batch"]  # ticks since the last reading in contact; many before the first one


class SixAxisContact(NamedTuple):
    """State of one contact."""

    delay: Float[Array, "*batch"]  # D [ticks]
    speed: Float[Array, "*batch"]  # v_0, approach speed along the direction
    impulse: Six  # I_r, impulse of the reference up to t - D [N s, N m s]
    drift: Six  # eps, pose of the model at t - D minus that of the reference
    direction: Six  # filtered wrench, with continuous sign
    modelled: Six  # direction for which the tangent model began
    path: Float[Array, "*batch"]  # X, depth of the hardware along the direction since the onset
    peak: Float[Array, "*batch"]  # largest force so far, per unit mass
    tool: Float[Array, "*batch"]  # largest square of the tool's share of a reading


class LedgerState(NamedTuple):
    """State of the impulse ledger from tick to tick."""

    ring: Float[Array, "samples 24 *batch"]  # measured pose, and pose, twist and impulse of the model
    filtered: Six  # measured pose behind the filter
    first: Six  # the same on the first tick
    aligned: Six  # measured pose as old as the reading of the last tick
    impulse: Six  # I_c, impulse commanded so far [N s, N m s]
    flight: FreeFlightState
    in_contact: Bool[Array, "*batch"]
    contact: SixAxisContact
    estimate: Estimate


class Reading(NamedTuple):
    """Readings of one tick, and the numerical model D ago."""

    wrench: Six  # W, about C's origin [N, N m]
    variance: Float[Array, "*batch"]  # of its size by noise
    pose: Six  # xi_a, measured pose as old as the wrench
    twist: Six  # its rate
    moved: Six  # its change since the last tick
    loud: Bool[Array, "*batch"]  # whether the wrench is that of a contact
