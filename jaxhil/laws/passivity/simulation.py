"""Time-domain passivity control (De Stefano et al.): no contact returns more energy than it absorbed.

    E(n) = E(n-1) + T F_c(n-1) (v_d(n-1) + v_d(n))/2
    if E(n) + T F v_d < 0:  F_c = F + alpha v_d,  alpha = -(E(n) + T F v_d)/(T v_d^2)

E is the energy that the numerical model has given to the contact, v_d its velocity, and T the control period.
The mean velocity of each period includes the energy T^2 F_c^2/(2 M) that the integrator of the model adds. E
is therefore exactly the energy that the model has lost, for every integrator. The mass M is not needed. The
virtual damping alpha returns E to 0. Then F_c = -E/(T v_d), limited to the magnitude of F. The compensator
needs no gain and no knowledge of the rig. One limitation remains: later contacts of the run can gain the
energy that an earlier, damped contact has dissipated (notebooks/guide/model.md section 6, item 17).
"""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.laws.simulation_base import Compensator, Gain, clear_lanes


class ObservedEnergy(NamedTuple):
    """Energy that the contact has received until a tick, and the signals that the next update needs."""

    energy: Float[Array, "*batch"]  # energy E [J] until the last tick
    command: Float[Array, "*batch"]  # force command F_c of the last tick [N]
    velocity: Float[Array, "*batch"]  # velocity of the numerical model at the last tick [m/s]


class Passivity(Compensator):
    """Compensator F_c = F, with a virtual damper if a contact would return more energy than it absorbed."""

    name: ClassVar[str] = "passivity"
    knows: ClassVar[tuple[str, ...]] = ()
    waits_for_contact: ClassVar[bool] = True
    reads_position: ClassVar[bool] = False
    gains: ClassVar[tuple[Gain, ...]] = ()

    def prepare(self, gains, constants):
        return constants.control_period

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        return ObservedEnergy(zeros, zeros, zeros)

    def restart(self, gains, state, begins, fresh):
        return clear_lanes(state, begins & fresh)

    def step(self, prepared, state, signals, tick):
        force, velocity = signals.force_measured, signals.velocity_desired
        energy = state.energy + state.command * (0.5 * prepared * (state.velocity + velocity))
        # Do not store an infinite or NaN energy, because all later energies would not be finite either.
        energy = jnp.where(jnp.isfinite(energy), energy, state.energy)
        travel = prepared * velocity
        active, limit = energy + force * travel < 0, jnp.abs(force)
        corrected = -energy / jnp.where(active & (travel != 0), travel, 1)
        corrected = jnp.where(travel == 0, 0, jnp.clip(corrected, -limit, limit))
        command = jnp.where(active, corrected, force)
        return command, ObservedEnergy(energy, command, velocity)


COMPENSATOR = Passivity()
