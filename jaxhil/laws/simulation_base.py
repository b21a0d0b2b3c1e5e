"""The interface of all compensators: a force law before the integration, a position command after it.

A compensator is stateless; its state is an explicit pytree of arrays of the batch shape (rings carry a
leading axis of samples) and its gains a dict of arrays, scalar or of the batch shape. `gains` lists them with
unit, bounds and the literature's rule: that list is what tuning, gain files and the rig's runtime go by.
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
    """One tunable number of a compensator."""

    name: str  # of the gain
    unit: str  # "1" if it has none
    lower: Callable[[Mechanism], float]  # bound, a function of the mechanism
    upper: Callable[[Mechanism], float]  # bound, likewise
    nominal: Callable[[Mechanism], float]  # the literature's own rule, likewise
    logarithmic: bool = False  # whether it is searched on a logarithmic scale
    # value at which it does nothing, if any; with all of them neutral the law passes the force on
    neutral: float | None = None
    # whether tuning moves it for this mechanism; if not, it stays at the nominal value
    tuned: Callable[[Mechanism], bool] = lambda mechanism: True
    # where all starts of tuning but the literature's have it, if not anywhere
    begins: Callable[[Mechanism], float] | None = None


_UNITS = {name: one.unit for law in ON_THE_RIG.values() for name, one in law.gains.items()}


def rig_gain(
    name: str,
    lower: Callable[[Mechanism], float],
    upper: Callable[[Mechanism], float],
    nominal: Callable[[Mechanism], float],
    **others: Any,
) -> Gain:
    """The `Gain` called `name` of a law that is in `jaxhil.rig` too, with the unit that is stated there.

    Raises KeyError for a name that no law there has.
    """
    return Gain(name, _UNITS[name], lower, upper, nominal, **others)


class Signals(NamedTuple):
    """What the controller knows at a tick."""

    force_measured: Float[Array, "*batch"]  # [N]
    position_desired: Float[Array, "*batch"]  # x_d of the numerical model [m]
    velocity_desired: Float[Array, "*batch"]  # v_d of the numerical model [m/s]
    position_measured: Float[Array, "*batch"]  # x_a of the motion simulator [m]
    age: Int[Array, "*batch"]  # ticks since this run began, 0 at its first


class Constants(NamedTuple):
    """What the controller knows of the rig."""

    control_period: Float[Array, "*batch"]  # T [s]
    clearance: Float[Array, "*batch"]  # between two surfaces [m]; infinite for one


def cleared(state: Any, begins: Array) -> Any:
    """A state with zeros on the lanes where a run begins."""
    return jax.tree.map(lambda leaf: jnp.where(begins, 0, leaf), state)


class Compensator(eqx.Module):
    """Interface; see the module's text."""

    name: eqx.AbstractClassVar[str]
    # What it must know of mechanism and rig beforehand, in the words of `estimates`.
    knows: eqx.AbstractClassVar[tuple[str, ...]]
    gains: eqx.AbstractClassVar[tuple[Gain, ...]]
    # Sets of gains that serve any mechanism, by name: those that differ from the nominal ones.
    settings: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType({})
    # Whether it estimates the delay of the force measurement: `force_delay`.
    estimates_delay: ClassVar[bool] = False
    # Whether it reads the measured position.
    reads_position: ClassVar[bool] = True
    # Whether, without noise, its F_c is 0 and its state such as a run begins with until the hardware touches:
    # the approach may then be skipped. Each law says so itself: it is not inherited.
    waits_for_contact: ClassVar[bool] = False
    # Whether it works out a motion of its own that it could follow whatever the hardware does.
    anticipates: ClassVar[bool] = False
    # Whether its step is so large that a solver is compiled apart from its runs.
    is_large: ClassVar[bool] = False

    def prepare(self, gains: Gains, constants: Constants) -> Any:
        """What `step` needs of the gains, worked out once per run; the gains themselves by default."""
        return gains

    def init(self, gains: Gains, constants: Constants, ring: int) -> Any:
        """State before the first tick, none by default; `ring` is the number of samples a delay line must
        hold."""
        return ()

    def restart(self, gains: Gains, state: Any, begins: Array, fresh: Array) -> Any:
        """State before the first tick of the next run, on the lanes where `begins`; by default all zeros.

        Filters and delay lines restart. Where `fresh`, it is the next contact of a schedule; else the
        same run goes on after a stretch of free flight and nothing learnt is dropped.
        """
        return cleared(state, begins)

    @abc.abstractmethod
    def step(self, prepared: Any, state: Any, signals: Signals, tick: Array) -> tuple[Array, Any]:
        """F_c [N] of this tick and the next state; `tick` is common to all lanes and never restarts."""

    def position_command(
        self, gains: Gains, state: Any, position: Array, velocity: Array, acceleration: Array
    ) -> tuple[Array, Any]:
        """Command [m] sent to the motion simulator for the model's new position; itself by default."""
        return position, state

    def noise_amplification(self, gains: Gains, constants: Constants) -> Float[Array, "*batch"]:
        """Standard deviation of F_c over that of white noise on the force readings, both tick by tick, in
        steady contact [1]: 1 by default, the measured force passed on. Differentiable by the gains."""
        return jnp.ones_like(constants.control_period)

    def identified(self, state: Any) -> tuple[Array, Array] | None:
        """Identified stiffness [N/m] and damping [N s/m], where the law identifies them."""
        return None

    def force_delay(self, gains: Gains, state: Any) -> Float[Array, "*batch"]:
        """Estimated delay [s] of the force measurement; of a law that `estimates_delay`."""
        raise NotImplementedError(f"{self.name} estimates no delay")
