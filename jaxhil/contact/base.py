"""Interface of the contact laws: contact force against penetration d > 0 [m] and its rate d' [m/s].

A law defines everything that depends on it: its keys in a mechanism file, its force in the simulation and in
plain floats, its ideal contact, and the functions that tuning, benchmarks and identification call. A new law
is one file with a class and one entry in `jaxhil.contact.laws`.

In the simulation a law is a pure function of the motion and of the law's state (`init`, `step`); a law
without memory has an empty state. A force is zero for d <= 0 and, unless tension is allowed, never negative.
Every argument broadcasts to the batch shape; slopes and depths of a segmented law have a leading axis of
segments. Arrays are those of `jax.numpy` unless stated otherwise.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, dataclass_transform

import numpy as np

from jaxhil.contact.float_law import FloatLaw
from jaxhil.contact.keys import ContactKey
from jaxhil.contact.regression import Regression, RegressionFamily
from jaxhil.errors import InputError, format_value

if TYPE_CHECKING:
    from jaxhil.contact.ideal_contact import IdealContact

__all__ = ["ContactLaw"]


@dataclass_transform(frozen_default=True)
class ContactLaw(abc.ABC):
    """Interface of all contact laws.

    A subclass becomes a frozen dataclass. It holds no arrays: all numbers come from the parameters
    (`jaxhil.contact.laws.ContactParameters`) or from the file's table `[contact]`, here called `contact`.
    """

    name: ClassVar[str] = ""  # name in mechanism files
    # Keys that only some laws have and that this law uses; None: unspecified, the law may use any of them.
    keys: ClassVar[tuple[ContactKey, ...] | None] = None
    stiffness_unit: ClassVar[str] = "N/m"
    damping_unit: ClassVar[str] = "N s/m"
    damped: ClassVar[bool] = True  # whether the force depends on the key `damping`
    dissipates_by: ClassVar[str] = ""  # source of dissipation of a law that rejects the key `damping`
    segmented: ClassVar[bool] = False  # whether each entry of `stiffness` is a list of slopes
    is_linear: ClassVar[bool] = False  # whether the force in contact is k d + b d'
    damped_as: ClassVar[str] = ""  # name of the law that adds damping to this one; empty: this law itself

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Make the subclass a frozen dataclass: programs are compiled per law, which must be hashable."""
        super().__init_subclass__(**kwargs)
        dataclass(frozen=True)(cls)

    # Simulation

    @property
    def remembers(self) -> bool:
        """Return whether the force depends on the deepest penetration so far.

        The simulation then follows state and motion between samples too. Without penetration the state is
        that before the first touch: a released surface is as new. The path between two penetrations counts
        only by its deepest point.
        """
        return False

    @property
    def jumps(self) -> bool:
        """Return whether the force jumps at a turning point; its peak is then sought between samples too."""
        return False

    @property
    def arcs(self) -> bool:
        """Return whether the force in a slow contact is nearly parabolic over a quarter of a control period.

        It is not if its slope changes at a depth, if it jumps at a turning point, or if it ends as a power of
        the depth.
        """
        return False

    @property
    def closed_form(self) -> bool:
        """Return whether the ideal contact has a closed form, computed in every run, or is integrated."""
        return type(self).reference is not ContactLaw.reference

    @property
    def simulated(self) -> ContactLaw:
        """Return the law that computes this force in the simulation, so that two laws can share a program."""
        return self

    def specialised(self, contact: Any, drawn: Callable[[str], bool]) -> ContactLaw:
        """Return the law specialised to keys whose value all batch elements share.

        Args:
            contact: the file's table `[contact]`.
            drawn: function that returns whether the value of a key varies over the batch.
        """
        return self.simulated

    def init(self, penetration: Any) -> tuple[Any, ...]:
        """Return the state before the first touch, in the batch shape of `penetration`."""
        return ()

    @abc.abstractmethod
    def step(
        self, parameters: Any, state: tuple[Any, ...], penetration: Any, rate: Any
    ) -> tuple[Any, tuple[Any, ...]]:
        """Return the force [N] at `penetration` [m] and `rate` [m/s], and the next state."""

    @abc.abstractmethod
    def edge(self, parameters: Any, rate: Any) -> Any:
        """Return the limit of the force [N] as d goes to 0 from above: the jump at a damped touch."""

    @abc.abstractmethod
    def hold(self, parameters: Any, state: tuple[Any, ...], penetration: Any, rate: Any) -> Any:
        """Return a smooth function that is positive until the penetrated surfaces separate, at its zero.

        It is the force before it is clamped, or a function of the same sign.
        """

    def corners(self, parameters: Any, state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return the penetrations [m] at which the slope of the force changes; none by default."""
        return ()

    def reference(self, parameters: Any, mass: Any, velocity: Any) -> IdealContact:
        """Return the ideal contact of equivalent `mass` [kg] and approach `velocity` [m/s].

        By default its motion is integrated (`jaxhil.contact.ideal_contact_motion`).
        """
        from jaxhil.contact.ideal_contact import IdealContact
        from jaxhil.contact.ideal_contact_motion import integrate_contact

        return IdealContact(*integrate_contact(self, parameters, mass, velocity)[:3])

    # Scales of the contact, from the parameters of scenarios as NumPy arrays

    def undamped_peak_force(self, parameters: Any, mass: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the peak force [N] of the undamped contacts, (slots, batch); integrated by default."""
        import jax
        import jax.numpy as jnp

        from jaxhil.contact.ideal_contact_motion import integrate_contact

        shape = np.shape(parameters.stiffness)
        undamped = parameters._replace(damping=np.zeros_like(parameters.damping))
        m, v = (jnp.broadcast_to(jnp.asarray(values), shape) for values in (mass, velocity))
        motion = integrate_contact(self, jax.tree.map(jnp.asarray, undamped), m, v)
        return np.asarray(motion.peak_force)

    def tangent_stiffness(self, parameters: Any, mass: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the largest slope of the force against the depth [N/m], (slots, batch).

        By default it is the stiffness. The parameters of a segmented law contain only its largest slope.
        """
        return parameters.stiffness

    def onset_damping(self, parameters: Any) -> np.ndarray:
        """Return the slope of the force against the rate at the onset of contact [N s/m], (slots, batch)."""
        return parameters.damping

    # Scales of the contact, from a mechanism file

    def nominal_peak_force(self, contact: Any, stiffness: list[float], mass: float, velocity: float) -> float:
        """Estimate the peak force [N] over the entries of `stiffness`; by default as a linear contact's."""
        return velocity * math.sqrt(max(stiffness) * mass)

    def damping_ratio(self, damping: float, mass: float, velocity: float, frequency: float) -> float:
        """Return the damping ratio [1] of a linear oscillator at `frequency` [rad/s] with equal loss."""
        return damping / (2 * mass * frequency)

    # Optional functions for other packages

    def perturb_damping(
        self, drawn: Callable[[str], np.ndarray], ratio: np.ndarray, mass: np.ndarray, velocity: np.ndarray
    ) -> tuple[str, np.ndarray]:
        """Return a key and its values after adding the dissipation of an oscillator with this damping ratio.

        Args:
            drawn: function that returns the draws of a key, (draws, ...); those of `stiffness` and `damping`
                are (draws, entries), for a segmented law with its first slope.
            ratio: damping ratio [1], (draws, 1).
            mass: equivalent mass [kg], (draws, 1).
            velocity: approach speed [m/s], (draws, 1).

        Raises:
            InputError: if the law does not define this function.
        """
        raise self._unstated("whose damping can be perturbed", "perturb_damping")

    def in_floats(self, contact: Any, stiffness: Any, damping: float) -> FloatLaw:
        """Return the law in plain floats, with one entry each of the lists `stiffness` and `damping`.

        Raise `InputError` if the law does not define this function.
        """
        raise self._unstated("in plain floats", "in_floats")

    def regression(self, contact: Any) -> Regression:
        """Return the law as a sum of known functions. Raise `InputError` if the law does not define this."""
        raise self._unstated("that is fitted to logs", "regression")

    def families(self, deepest: float, entries: int) -> list[RegressionFamily]:
        """Return the regression families that identification tries; none by default.

        Args:
            deepest: largest penetration in the logs [m].
            entries: number of entries of the lists `stiffness` and `damping` that occur in the logs.
        """
        return []

    def coefficients(self, contact: Any, stiffness: Any, damping: float) -> list[float]:
        """Return the coefficients of `regression`: those of one entry, then the shared ones."""
        return [stiffness, damping]

    def file_values(self, fitted: Mapping[str, np.ndarray], entry: int) -> dict[str, np.ndarray]:
        """Return values by dotted key of the mechanism file from the `fitted` coefficients of an entry."""
        return {f"contact.stiffness.{entry}": fitted["stiffness"]}

    def _unstated(self, which: str, method: str) -> InputError:
        """Return the error for a law that lacks an optional `method`."""
        expected = f"a law {which} (ContactLaw.{method})"
        return InputError(f"contact.law: found {format_value(self.name)}, expected {expected}")
