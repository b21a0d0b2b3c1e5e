"""User-defined compensator and contact law in a separate module, written against jaxhil's interfaces."""

from typing import ClassVar

import jax.numpy as jnp

import jaxhil
from jaxhil.rig.registry import Compensator, GainSpecification


class ScaledLead(jaxhil.Compensator):
    """Phase lead without a filter: F_c = F + toy_lead (F - F_previous)/T."""

    name: ClassVar[str] = "scaled_lead"
    knows: ClassVar[tuple[str, ...]] = ("force delay",)
    gains: ClassVar[tuple[jaxhil.Gain, ...]] = (
        jaxhil.Gain(
            "toy_lead", "s", lambda m: 0.0, lambda m: 0.05, lambda m: m.rig.force_sensor.delay, neutral=0.0
        ),
    )

    def prepare(self, gains, constants):
        return gains["toy_lead"] / constants.control_period

    def init(self, gains, constants, ring):
        return jnp.zeros_like(constants.control_period)

    def restart(self, gains, state, begins, fresh):
        return jnp.where(begins, 0, state)

    def step(self, prepared, state, signals, tick):
        force = signals.force_measured
        return force + prepared * (force - state), force


class SquaredSpring(jaxhil.ContactLaw):
    """Contact law F = k d^2 with `stiffness` k [N/m^2]; its ideal contact is integrated."""

    name: ClassVar[str] = "squared_spring"

    def step(self, parameters, state, penetration, rate):
        return jnp.where(penetration > 0, parameters.stiffness * penetration**2, 0), state

    def onset_force(self, parameters, rate):
        return jnp.zeros_like(rate)

    def separation_function(self, parameters, state, penetration, rate):
        return parameters.stiffness * penetration


class ScaledLeadOnTheRig(Compensator):
    """Rig controller of `ScaledLead` in plain Python."""

    gains: ClassVar = {"toy_lead": GainSpecification("s")}

    def __init__(self, gains, period, clearance):
        self._ticks = gains["toy_lead"] / period
        self._before = 0.0

    def step(self, force_measured, position_desired, velocity_desired, position_measured):
        command = force_measured + self._ticks * (force_measured - self._before)
        self._before = force_measured
        return command

    def reset(self):
        self._before = 0.0
