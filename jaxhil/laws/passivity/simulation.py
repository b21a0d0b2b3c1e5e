"""Time-domain passivity control (De Stefano et al.): the contact never returns more energy than it took.

    E(n) = E(n-1) + T F(n) v_d(n),     where E < 0:  F_c = F + alpha v_d,  alpha = -E/(T v_d^2)

E is the energy that the numerical model has given to the contact. The energy that the virtual damping alpha
dissipates counts in E, which therefore returns to 0. Then F_c = -E(n-1)/(T v_d), between 0 and F however
small v_d is. The compensator needs no gain and no knowledge of the rig. However, energy that a damped contact
has dissipated is a reserve that later contacts of the run may spend, and energy from sampling is not observed
(notebooks/guide/model.md section 6, item 17).
"""

from typing import ClassVar

import jax.numpy as jnp

from jaxhil.laws.simulation_base import Compensator, Gain


class Passivity(Compensator):
    """Compensator F_c = F + alpha v_d where the observed energy is negative; see the module's docstring."""

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
        # An infinite or NaN energy is not stored: it would remain so.
        energy = jnp.where(active, 0, jnp.where(energy < jnp.inf, energy, state))
        return jnp.where(active, corrected, force), energy


COMPENSATOR = Passivity()
