"""Interface of all compensators in JAX: a force before the model's integration step, a command after it.

A compensator object does not change. Its methods take and return the state, a pytree of arrays of the batch
shape; ring buffers have an additional leading axis of samples. Gains are a dict of arrays, scalar or of the
batch shape. `Compensator.gains` lists all gains with unit, bounds and the rule of the literature.
"""

import abc
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import COMPENSATORS as ON_THE_RIG

Gains = dict[str, Array]


class Gain(NamedTuple):
    """Specification of one gain of a compensator.

    Attributes:
        name: name of the gain.
        unit: SI unit; "1" if dimensionless.
        lower: lower bound as a function of the mechanism.
        upper: upper bound as a function of the mechanism.
        nominal: value by the rule of the literature, as a function of the mechanism.
        logarithmic: whether tuning searches on a logarithmic scale.
        neutral: value that makes the gain ineffective, or None. If all gains are neutral, the force command
            is the measured force.
        tuned: function that returns whether tuning may change the gain for a mechanism.
        begins: initial value for tuning, as a function of the mechanism; None for any value within the
            bounds. Tuning also starts from the nominal value.
    """

    name: str
    unit: str
    lower: Callable[[Mechanism], float]
    upper: Callable[[Mechanism], float]
    nominal: Callable[[Mechanism], float]
    logarithmic: bool = False
    neutral: float | None = None
    tuned: Callable[[Mechanism], bool] = lambda mechanism: True
    begins: Callable[[Mechanism], float] | None = None


_GAIN_UNITS = {name: gain.unit for law in ON_THE_RIG.values() for name, gain in law.gains.items()}


def rig_gain(
    name: str,
    lower: Callable[[Mechanism], float],
    upper: Callable[[Mechanism], float],
    nominal: Callable[[Mechanism], float],
    **others: Any,
) -> Gain:
    """Create a `Gain` with the unit that a compensator in `jaxhil.rig` states for this name.

    `others` are further fields of `Gain`. Raise KeyError if no compensator of the rig has the gain.
    """
    return Gain(name, _GAIN_UNITS[name], lower, upper, nominal, **others)


class Signals(NamedTuple):
    """Inputs of the compensator on one tick."""

    force_measured: Float[Array, "*batch"]  # force reading F [N]
    position_desired: Float[Array, "*batch"]  # position x_d of the numerical model [m]
    velocity_desired: Float[Array, "*batch"]  # velocity v_d of the numerical model [m/s]
    position_measured: Float[Array, "*batch"]  # measured position x_a of the motion simulator [m]
    age: Int[Array, "*batch"]  # number of ticks since the run began; 0 on the first tick


class KnownConstants(NamedTuple):
    """Constants of the rig that the compensator knows."""

    control_period: Float[Array, "*batch"]  # control period T [s]
    clearance: Float[Array, "*batch"]  # clearance of a two-sided contact [m]; infinite for one-sided contact


def clear_lanes(state: Any, begins: Array) -> Any:
    """Set the state to zero on the lanes in which a run begins."""
    return jax.tree.map(lambda leaf: jnp.where(begins, 0, leaf), state)


class Compensator(eqx.Module):
    """Interface of a compensator in JAX.

    Attributes:
        name: name of the compensator.
        knows: values of mechanism and rig that the compensator needs (`jaxhil.laws.shared.nominal_values`).
        gains: specifications of the gains.
        settings: named sets of gains for any mechanism; gains that a set does not state are nominal.
        estimates_delay: whether the compensator estimates the delay of the force measurement.
        reads_position: whether the compensator uses the measured position.
        waits_for_contact: whether, without noise, F_c is 0 and the state does not change before the hardware
            is in contact, so that the approach may be skipped. Every class sets this attribute itself.
        anticipates: whether the compensator predicts a reference motion of the contact, which it could follow
            even without measurements.
        is_large: whether `step` is so large that solvers are compiled separately from runs.
        tuned_without_derivatives: whether tuning uses a search without derivatives, because the program with
            derivatives takes too long to compile.
    """

    name: eqx.AbstractClassVar[str]
    knows: eqx.AbstractClassVar[tuple[str, ...]]
    gains: eqx.AbstractClassVar[tuple[Gain, ...]]
    settings: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType({})
    estimates_delay: ClassVar[bool] = False
    reads_position: ClassVar[bool] = True
    waits_for_contact: ClassVar[bool] = False
    anticipates: ClassVar[bool] = False
    is_large: ClassVar[bool] = False
    tuned_without_derivatives: ClassVar[bool] = False

    def prepare(self, gains: Gains, constants: KnownConstants) -> Any:
        """Return the values that `step` needs, computed from the gains once per run; by default the gains."""
        return gains

    def init(self, gains: Gains, constants: KnownConstants, ring: int) -> Any:
        """Return the state before the first tick; by default an empty tuple.

        Args:
            gains: gains by name.
            constants: constants of the rig.
            ring: number of samples that a delay line must store.
        """
        return ()

    def restart(self, gains: Gains, state: Any, begins: Array, fresh: Array) -> Any:
        """Return the state with filters and delay lines restarted on the lanes `begins`; default: all zeros.

        Args:
            gains: gains by name.
            state: state after the last tick.
            begins: whether each lane restarts.
            fresh: whether a lane that restarts begins a new run, with the next contact of its scenario. If
                not, its run continues after a skipped free flight, and keeps its estimates.
        """
        return clear_lanes(state, begins)

    @abc.abstractmethod
    def step(self, prepared: Any, state: Any, signals: Signals, tick: Array) -> tuple[Array, Any]:
        """Return the force command F_c [N] of this tick, and the next state.

        Args:
            prepared: result of `prepare`.
            state: state after the last tick.
            signals: inputs of this tick.
            tick: number of this tick, common to all lanes; a new run does not reset it.
        """

    def position_command(
        self, gains: Gains, state: Any, position: Array, velocity: Array, acceleration: Array
    ) -> tuple[Array, Any]:
        """Return the position command [m] and the state; the default command is the model's position.

        Args:
            gains: gains by name.
            state: state after this tick's `step`.
            position: new position of the numerical model [m].
            velocity: new velocity of the numerical model [m/s].
            acceleration: new acceleration of the numerical model [m/s^2].
        """
        return position, state

    def noise_amplification(self, gains: Gains, constants: KnownConstants) -> Float[Array, "*batch"]:
        """Return the noise amplification [1]: the standard deviation of F_c for unit white noise on F.

        The default is 1, for F_c = F. The value is differentiable with respect to the gains.
        """
        return jnp.ones_like(constants.control_period)

    def identified(self, state: Any) -> tuple[Array, Array] | None:
        """Return the identified stiffness [N/m] and damping [N s/m]; None without an identification."""
        return None

    def force_delay(self, gains: Gains, state: Any) -> Float[Array, "*batch"]:
        """Return the estimated delay [s] of the force measurement.

        Raise NotImplementedError if the class does not set `estimates_delay`.
        """
        raise NotImplementedError(f"{self.name}: does not estimate the force delay")
