"""Interface of all compensators in JAX: a force before the integration, a position command after it.

A compensator is stateless. Its state is an explicit pytree of arrays of the batch shape (rings have a leading
axis of samples). Its gains are a dict of arrays, scalar or of the batch shape; `gains` lists them with unit,
bounds and the literature's rule, for tuning, gain files and the rig.
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
    """Tunable number of a compensator."""

    name: str
    unit: str  # "1" if it has none
    lower: Callable[[Mechanism], float]  # lower bound for a mechanism
    upper: Callable[[Mechanism], float]  # upper bound for a mechanism
    nominal: Callable[[Mechanism], float]  # value by the literature's rule for a mechanism
    logarithmic: bool = False  # whether tuning searches on a logarithmic scale
    # value without effect, if any; with all such values the compensated force is the measured force
    neutral: float | None = None
    # whether tuning changes it for a mechanism; if not, it stays at the nominal value
    tuned: Callable[[Mechanism], bool] = lambda mechanism: True
    # value in all starts of tuning but the literature's; None: any value within the bounds
    begins: Callable[[Mechanism], float] | None = None


_GAIN_UNITS = {name: gain.unit for law in ON_THE_RIG.values() for name, gain in law.gains.items()}


def rig_gain(
    name: str,
    lower: Callable[[Mechanism], float],
    upper: Callable[[Mechanism], float],
    nominal: Callable[[Mechanism], float],
    **others: Any,
) -> Gain:
    """Return the gain `name` of a compensator that the rig also has, with the unit stated there.

    The other arguments are fields of `Gain`. Raise KeyError if no compensator of the rig has the gain.
    """
    return Gain(name, _GAIN_UNITS[name], lower, upper, nominal, **others)


class Signals(NamedTuple):
    """Inputs of the compensator at a tick."""

    force_measured: Float[Array, "*batch"]  # [N]
    position_desired: Float[Array, "*batch"]  # x_d of the numerical model [m]
    velocity_desired: Float[Array, "*batch"]  # v_d of the numerical model [m/s]
    position_measured: Float[Array, "*batch"]  # x_a of the motion simulator [m]
    age: Int[Array, "*batch"]  # ticks since this run began, 0 on its first tick


class KnownConstants(NamedTuple):
    """Constants of the rig that the compensator knows."""

    control_period: Float[Array, "*batch"]  # T [s]
    clearance: Float[Array, "*batch"]  # of a two-sided contact [m]; infinite for a one-sided one


def clear_lanes(state: Any, begins: Array) -> Any:
    """Set the state to zero on the lanes where a run begins."""
    return jax.tree.map(lambda leaf: jnp.where(begins, 0, leaf), state)


class Compensator(eqx.Module):
    """Interface of a compensator; see the module's docstring."""

    name: eqx.AbstractClassVar[str]
    # Required knowledge of mechanism and rig, by the names in `jaxhil.laws.shared.nominal_values`.
    knows: eqx.AbstractClassVar[tuple[str, ...]]
    gains: eqx.AbstractClassVar[tuple[Gain, ...]]
    # Named sets of gains that serve any mechanism; each has only the gains that differ from the nominal ones.
    settings: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType({})
    # Whether it estimates the delay of the force measurement (`force_delay`).
    estimates_delay: ClassVar[bool] = False
    # Whether it reads the measured position.
    reads_position: ClassVar[bool] = True
    # Whether, without noise, F_c is 0 and the state that of the first tick until the hardware touches: the
    # approach may then be skipped. Each class states this itself; it is not inherited.
    waits_for_contact: ClassVar[bool] = False
    # Whether it computes a reference motion that it could follow whatever the hardware does.
    anticipates: ClassVar[bool] = False
    # Whether its step is so large that solvers are compiled separately from its runs.
    is_large: ClassVar[bool] = False

    def prepare(self, gains: Gains, constants: KnownConstants) -> Any:
        """Return what `step` computes from the gains only once per run; by default the gains."""
        return gains

    def init(self, gains: Gains, constants: KnownConstants, ring: int) -> Any:
        """Return the state before the first tick; by default there is none.

        Args:
            gains: gains by name.
            constants: constants of the rig.
            ring: number of samples that a delay line must store.
        """
        return ()

    def restart(self, gains: Gains, state: Any, begins: Array, fresh: Array) -> Any:
        """Return the state before the first tick of a run, on the lanes where `begins`; by default zeros.

        Filters and delay lines restart.

        Args:
            gains: gains by name.
            state: state after the last tick.
            begins: lanes where a run begins.
            fresh: lanes where this is the next contact of a schedule; elsewhere the same run continues, with
                its estimates, after a skipped free flight.
        """
        return clear_lanes(state, begins)

    @abc.abstractmethod
    def step(self, prepared: Any, state: Any, signals: Signals, tick: Array) -> tuple[Array, Any]:
        """Return F_c [N] of this tick and the next state.

        Args:
            prepared: result of `prepare`.
            state: state after the last tick.
            signals: inputs of this tick.
            tick: number of this tick, common to all lanes; it never restarts.
        """

    def position_command(
        self, gains: Gains, state: Any, position: Array, velocity: Array, acceleration: Array
    ) -> tuple[Array, Any]:
        """Return the position command [m] and the state, by default the model's position.

        Args:
            gains: gains by name.
            state: state after this tick's `step`.
            position: new position of the numerical model [m].
            velocity: its velocity [m/s].
            acceleration: its acceleration [m/s^2].
        """
        return position, state

    def noise_amplification(self, gains: Gains, constants: KnownConstants) -> Float[Array, "*batch"]:
        """Return the standard deviation of F_c in steady contact over that of white force noise [1].

        It is 1 by default, for the measured force itself, and differentiable with respect to the gains.
        """
        return jnp.ones_like(constants.control_period)

    def identified(self, state: Any) -> tuple[Array, Array] | None:
        """Return identified stiffness [N/m] and damping [N s/m]; None if it identifies none."""
        return None

    def force_delay(self, gains: Gains, state: Any) -> Float[Array, "*batch"]:
        """Return the estimated delay [s] of the force measurement, if the class `estimates_delay`."""
        raise NotImplementedError(f"{self.name} estimates no delay")
