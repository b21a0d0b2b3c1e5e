"""Interface of six-axis compensators in JAX: a wrench before the model's integration, a pose after it.

As on one axis (`jaxhil.laws.simulation_base`), a compensator object does not change. Its methods take and
return the state, a pytree of arrays whose last axes are the lanes. Gains are a dict of arrays, scalar or of
the batch shape. Wrenches, poses and twists are six numbers (x, y, z, rx, ry, rz) along the axes of the target
frame T (notebooks/guide/six_axes.md, section 1).
"""

import abc
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.laws.shared.nominal_values import axis_lags
from jaxhil.laws.simulation_base import Gain, Gains, KnownConstants

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
LAG_LEADS = tuple(f"lag_lead_{name}" for name in COORDINATES)

Six = Float[Array, "6 *batch"]


class SixAxisSignals(NamedTuple):
    """Inputs of the compensator on one tick."""

    wrench: tuple[Array, ...]  # measured wrench about T's origin [N, N m], six arrays (*batch)
    pose_desired: Six  # coordinates of the numerical model [m, rad]
    twist_desired: Six  # twist of the numerical model [m/s, rad/s]
    pose_measured: Six | None  # coordinates of the hardware [m, rad]; None unless `reads_pose` is true
    age: Int[Array, "*batch"]  # number of ticks since the run began; 0 on the first tick


class SixAxisConstants(NamedTuple):
    """Constants of the rig that the compensator knows."""

    control_period: Float[Array, "*batch"]  # control period T [s]
    mass_matrix: Float[Array, "6 6 *batch"]  # relative mass matrix M at the docking pose
    inverse_mass: Float[Array, "6 6 *batch"]  # inverse of M
    # (1 - M_t M^-1)^-1 about the origin of frame C: converts a reading, which contains the inertia of the
    # tool, to the contact's wrench; the identity without a tool
    tool_correction: Float[Array, "6 6 *batch"]

    @property
    def of_channel(self) -> KnownConstants:
        """Return the constants for a one-axis compensator that acts on one channel of the wrench."""
        return KnownConstants(self.control_period, jnp.full_like(self.control_period, jnp.inf))


class SixAxisCompensator(eqx.Module):
    """Interface of a compensator in six axes.

    `jaxhil.laws.simulation_base.Compensator` explains the class variables, except `reads_pose`: whether the
    compensator uses the measured pose.
    """

    name: eqx.AbstractClassVar[str]
    knows: eqx.AbstractClassVar[tuple[str, ...]]
    gains: eqx.AbstractClassVar[tuple[Gain, ...]]
    settings: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType({})
    reads_pose: ClassVar[bool] = False
    anticipates: ClassVar[bool] = False
    is_large: ClassVar[bool] = False
    tuned_without_derivatives: ClassVar[bool] = False

    def prepare(self, gains: Gains, constants: SixAxisConstants) -> Any:
        """Return the values that `step` needs, computed once per run; by default the gains."""
        return gains

    def init(self, prepared: Any, constants: SixAxisConstants, start: SixAxisSignals, ring: int) -> Any:
        """Return the state before the first tick; by default an empty tuple.

        Args:
            prepared: result of `prepare`.
            constants: constants of the rig.
            start: signals before the first tick: uniform motion, no wrench, and None for `pose_measured`.
            ring: number of samples that a delay line must store, a power of two.
        """
        return ()

    @abc.abstractmethod
    def step(
        self, prepared: Any, state: Any, signals: SixAxisSignals, tick: Array
    ) -> tuple[tuple[Array, ...], Any]:
        """Return the wrench on the numerical model about the target's origin T [N, N m], and the next state.

        Args:
            prepared: result of `prepare`.
            state: state after the last tick.
            signals: inputs of this tick.
            tick: number of this tick, common to all lanes.
        """

    def pose_command(self, gains: Gains, pose: Six, rates: Six) -> Six:
        """Return the pose command from the numerical model's coordinates `pose` and their `rates`.

        By default, the command is pose + lead * rates with the gains `lag_lead_...`. Without these gains, the
        command is the pose.
        """
        if LAG_LEADS[0] not in gains:
            return pose
        leads = jnp.stack([jnp.zeros_like(pose[0]) + gains[name] for name in LAG_LEADS])
        return pose + leads * rates


def lag_leads(equalise: bool) -> tuple[Gain, ...]:
    """Return the gains `lag_lead_...`, one lead time of the pose command for each coordinate.

    Tuning does not change these gains.

    Args:
        equalise: if True, the nominal lead time is the coordinate's lag minus the shortest lag, so that all
            coordinates lag equally. If False, the nominal lead time is 0.
    """

    def gain(index: int, name: str) -> Gain:
        def upper(mechanism: Any) -> float:
            return 2 * max(axis_lags(mechanism)) + 0.01

        def excess(mechanism: Any) -> float:
            lags = axis_lags(mechanism)
            return lags[index] - min(lags)

        def nominal(mechanism: Any) -> float:
            return excess(mechanism) if equalise else 0.0

        return Gain(name, "s", lambda mechanism: 0.0, upper, nominal, tuned=lambda mechanism: False)

    return tuple(gain(index, name) for index, name in enumerate(LAG_LEADS))
