"""Time-domain passivity control (De Stefano et al.): a contact returns at most the energy it absorbed.

    E(n) = E(n-1) + T F(n) v_d(n),     if E < 0:  F_c = F + alpha v_d,  alpha = -E/(T v_d^2)

E is the energy that the numerical model has given to the contact, v_d its velocity, and T the control period.
The virtual damping alpha dissipates -E, so that E returns to 0. Then F_c = -E(n-1)/(T v_d), which is between
0 and F for any small v_d. The compensator needs no gain and no knowledge of the rig. Two limitations remain:
later contacts of the run can gain the energy that an earlier, damped contact has dissipated, and energy that
the sampling adds is not observed (notebooks/guide/model.md section 6, item 17).
"""

from typing import ClassVar

import jax.numpy as jnp

from jaxhil.laws.simulation_base import Compensator, Gain


class Passivity(Compensator):
    """Compensator F_c = F + alpha v_d while the observed energy is negative; see the module's docstring."""

    name: ClassVar[str] = "passivity"
    knows: ClassVar[tuple[str, ...]] = ()
    waits_for_contact: ClassVar[bool] = True
    reads_position: ClassVar[bool] = False
    gains: ClassVar[tuple[Gain, ...]] = ()

    def prepare(self, gains, constants):
        return constants.control_period

    def init(self, gains, constants, ring):
        return jnp.zeros_like(constants.control_period)

    def restart(self, gains, state, begins, fresh):
        return jnp.where(begins & fresh, 0, state)

    def step(self, prepared, state, signals, tick):
        force = signals.force_measured
        travel = prepared * signals.velocity_desired
        energy = state + force * travel
        active = energy < 0
        corrected = -state / jnp.where(active, travel, 1)
        # Do not store an infinite or NaN energy, because it would never become finite again.
        energy = jnp.where(active, 0, jnp.where(energy < jnp.inf, energy, state))
        return jnp.where(active, corrected, force), energy


COMPENSATOR = Passivity()
