"""Impulse ledger in six axes in JAX.

The present reading is the wrench that should have acted on the numerical model a time D earlier, where D is
the delay of the whole loop. The compensator adds the impulse of every reading to a reference that is delayed
by D. It predicts the impulse from t - D to the present with a scalar model of the contact. The command then
corrects the difference between the reference's impulse and the impulse commanded so far. `six_axes/README.md`
states the equations (a) to (e).
"""

from typing import ClassVar

import jax.numpy as jnp

from jaxhil.lanes import select_lanes
from jaxhil.laws.impulse_ledger.six_axes.constants import INITIAL_CONTACT_AGE
from jaxhil.laws.impulse_ledger.six_axes.gains import GAINS
from jaxhil.laws.impulse_ledger.six_axes.impulse_accounting.simulation import follow, onset
from jaxhil.laws.impulse_ledger.six_axes.reading.simulation import read, record
from jaxhil.laws.impulse_ledger.six_axes.simulation import wrench_at_target
from jaxhil.laws.impulse_ledger.six_axes.state import (
    FreeFlightState,
    LedgerState,
    PreparedLedger,
    SixAxisContact,
)
from jaxhil.laws.impulse_ledger.six_axes.tangent_model.simulation import begin_estimate
from jaxhil.laws.shared import nominal_values
from jaxhil.laws.simulation_base import Gain
from jaxhil.laws.six_axis_base import SixAxisCompensator

SPREADS = "stiffness_spread", "damping_spread", "force_spread", "curvature_spread"


class ImpulseLedger(SixAxisCompensator):
    """Compensator that corrects the impulse on the numerical model; see the module's docstring."""

    name: ClassVar[str] = "impulse_ledger"
    knows: ClassVar[tuple[str, ...]] = (
        nominal_values.EQUIVALENT_MASS,
        nominal_values.FORCE_DELAY,
        nominal_values.FORCE_NOISE,
    )
    reads_pose: ClassVar[bool] = True
    is_large: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = GAINS

    def prepare(self, gains, constants):
        period = constants.control_period
        delay = gains["identification_delay"]
        filter_lag = jnp.minimum(gains["pose_filter"], delay)
        correction, inverse = constants.tool_correction, constants.inverse_mass
        return PreparedLedger(
            gains=gains,
            constants=constants,
            pole=filter_lag / (filter_lag + period),
            back=(delay - filter_lag) / period,
            prior=begin_estimate(tuple(gains[name] for name in SPREADS)),
            noise_metric=jnp.einsum("ki...,kl...,lj...->ij...", correction, inverse, correction),
        )

    def init(self, prepared, constants, start, ring):
        period = constants.control_period
        zero, zeros = jnp.zeros_like(period), jnp.zeros_like(start.pose_desired)
        # Before the run the motion is uniform: the slot of tick k contains the motion of tick k - ring.
        ticks = jnp.arange(-ring, 0, dtype=period.dtype).reshape(-1, 1, *[1] * period.ndim)
        moving = start.pose_desired[None] + ticks * (period[None] * start.twist_desired)[None]
        still = jnp.zeros_like(moving)
        rows = [still, moving, still + start.twist_desired[None], still]
        return LedgerState(
            ring=jnp.concatenate(rows, axis=1),
            filtered=zeros,
            first=zeros,
            aligned=zeros,
            impulse=zeros,
            flight=FreeFlightState(zeros, zero, zeros, zeros, zero, zero + INITIAL_CONTACT_AGE),
            in_contact=zero > 0,
            contact=SixAxisContact(zero, zero + 1, zeros, zeros, zeros, zeros, zero, zero, zero),
            estimate=prepared.prior,
        )

    def step(self, prepared, state, signals, tick):
        state = record(prepared, state, signals, tick)
        reading, state = read(prepared, state, signals, tick)
        begins = reading.is_contact & ~state.in_contact
        contact = select_lanes(begins, onset(prepared, state, reading, signals), state.contact)
        in_contact = state.in_contact | reading.is_contact
        command, contact, estimate = follow(prepared, state, reading, (contact, state.estimate, begins), tick)
        ticks_since_contact = jnp.where(reading.is_contact, 0, state.flight.ticks_since_contact + 1)
        period = prepared.constants.control_period
        in_contact = in_contact & ~(ticks_since_contact * period > prepared.gains["release_time"])
        command = jnp.where(in_contact[None], command, 0)
        state = state._replace(
            impulse=state.impulse + period[None] * command,
            flight=state.flight._replace(ticks_since_contact=ticks_since_contact),
            in_contact=in_contact,
            contact=contact,
            estimate=estimate,
        )
        return tuple(wrench_at_target(command, signals.pose_desired)), state


COMPENSATOR = ImpulseLedger()
