"""A compensator, its class for the rig and a contact law from outside the package, as a user writes them."""

from typing import ClassVar

import jax.numpy as jnp

import jaxhil
from jaxhil.runtime.registry import Compensator, GainSpecification


class Difference(jaxhil.Compensator):
    """F_c = F + share (F - F of the tick before)."""

    name: ClassVar[str] = "difference"
    knows: ClassVar[tuple[str, ...]] = ()
    gains: ClassVar[tuple[jaxhil.Gain, ...]] = (
        jaxhil.Gain("share", "1", lambda m: 0.0, lambda m: 20.0, lambda m: 2.0, neutral=0.0),
    )

    def init(self, gains, constants, ring):
        return jnp.zeros_like(constants.control_period)

    def restart(self, gains, state, begins, fresh):
        return jnp.where(begins, 0, state)

    def step(self, prepared, state, signals, tick):
        force = signals.force_measured
        return force + prepared["share"] * (force - state), force


class DifferenceOnTheRig(Compensator):
    """The same, tick by tick."""

    gains: ClassVar = {"share": GainSpecification("1")}

    def __init__(self, gains, period, clearance):
        self._share = gains["share"]
        self._before = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured):
        command = force_measured + self._share * (force_measured - self._before)
        self._before = force_measured
        return command

    def reset(self):
        self._before = 0.0


class Quadratic(jaxhil.ContactLaw):
    """F = k d (1 + 100 d), without a closed form: its reference is integrated."""

    name: ClassVar[str] = "quadratic"

    def step(self, parameters, state, penetration, rate):
        depth = jnp.maximum(penetration, 0)
        return parameters.stiffness * depth * (1 + 100 * depth), state

    def edge(self, parameters, rate):
        return jnp.zeros_like(rate)

    def hold(self, parameters, state, penetration, rate):
        return penetration
