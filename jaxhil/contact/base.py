"""Interface of the contact laws, which compute the contact force from the penetration and its rate.

A law defines its keys in a mechanism file, its force and its ideal contact. It also has functions for tuning,
benchmarks and identification. The force has two versions: one in JAX, and one in Python floats for loops in
real time. To add a law, write a module with a subclass of `ContactLaw` and add an entry to
`jaxhil.contact.laws`.

In the simulation a law is a pure function of the penetration d [m], its rate d' [m/s] and the law's state
(`init`, `step`); a law without memory has an empty state. The force is 0 for d <= 0 and, unless the law
allows tension, never negative. All arguments broadcast to the batch shape; slopes and depths of a segmented
(piecewise-linear) law have a leading axis of segments. Arrays are `jax.numpy` arrays unless stated otherwise.
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
    """Base class of all contact laws.

    Every subclass is a frozen dataclass without arrays. The methods take all numbers from `parameters`
    (`jaxhil.contact.laws.ContactParameters`) or from `contact`, the table `[contact]` of a mechanism file.
    """

    name: ClassVar[str] = ""  # name in mechanism files
    # Keys of `[contact]` that this law uses in addition to the keys of all laws; None: the law may use any
    # key.
    keys: ClassVar[tuple[ContactKey, ...] | None] = None
    stiffness_unit: ClassVar[str] = "N/m"
    damping_unit: ClassVar[str] = "N s/m"
    is_damped: ClassVar[bool] = True  # whether the force depends on the key `damping`
    dissipation_process: ClassVar[str] = ""  # what dissipates energy in a law without the key `damping`
    is_segmented: ClassVar[bool] = False  # whether each entry of `stiffness` is a list of slopes
    is_linear: ClassVar[bool] = False  # whether the force in contact is k d + b d'
    damped_law: ClassVar[str] = ""  # name of the same law with damping; empty: this law itself

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Make the subclass a frozen dataclass, so that laws can be compared and hashed."""
        super().__init_subclass__(**kwargs)
        dataclass(frozen=True)(cls)

    # Simulation

    @property
    def has_memory(self) -> bool:
        """Return whether the force depends on the deepest penetration so far.

        If it does, the simulation also updates the law's state between samples. `step` must reset the state
        at d <= 0. Between two calls of `step`, only the deepest point of the motion may affect the state.
        """
        return False

    @property
    def has_reversal_jump(self) -> bool:
        """Return whether the force jumps when the motion reverses.

        If it does, the peak force may lie between two samples.
        """
        return False

    @property
    def is_locally_parabolic(self) -> bool:
        """Return whether one parabola per quarter period approximates the force of a contact of many ticks.

        This is false if the slope changes at a given depth, if the force jumps when the motion reverses, or
        if the force near 0 is proportional to a power of the depth.
        """
        return False

    @property
    def has_closed_form(self) -> bool:
        """Return whether the ideal contact has a closed form, so that no numerical integration is needed."""
        return type(self).ideal_contact is not ContactLaw.ideal_contact

    @property
    def simulation_law(self) -> ContactLaw:
        """Return an equivalent law to simulate, so that laws with equal forces share a compiled program."""
        return self

    def specialise(self, contact: Any, drawn: Callable[[str], bool]) -> ContactLaw:
        """Return a faster law with the same force, if certain keys have the same value in the whole batch.

        Args:
            contact: table `[contact]` of the mechanism file.
            drawn: function that returns whether the value of a key differs between batch elements.
        """
        return self.simulation_law

    def init(self, penetration: Any) -> tuple[Any, ...]:
        """Return the state of the law before the first touch, in the batch shape of `penetration`."""
        return ()

    @abc.abstractmethod
    def step(
        self, parameters: Any, state: tuple[Any, ...], penetration: Any, rate: Any
    ) -> tuple[Any, tuple[Any, ...]]:
        """Return the force [N] at a `penetration` [m] and its `rate` [m/s], and the next state of the law."""

    @abc.abstractmethod
    def onset_force(self, parameters: Any, rate: Any) -> Any:
        """Return the force [N] just inside the surface: its limit as d goes to 0 from above."""

    @abc.abstractmethod
    def separation_function(
        self, parameters: Any, state: tuple[Any, ...], penetration: Any, rate: Any
    ) -> Any:
        """Return a smooth value that is positive during the contact and crosses 0 at the separation.

        The value is the force before clamping at 0, or has the same sign as this force.
        """

    def breakpoints(self, parameters: Any, state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return the penetrations [m] at which the slope of the force changes; none by default."""
        return ()

    def ideal_contact(self, parameters: Any, mass: Any, velocity: Any) -> IdealContact:
        """Return the ideal contact for an equivalent `mass` [kg] and an approach `velocity` [m/s].

        By default, this method integrates the motion numerically (`jaxhil.contact.ideal_contact_motion`).
        """
        from jaxhil.contact.ideal_contact import IdealContact
        from jaxhil.contact.ideal_contact_motion import integrate_contact

        return IdealContact(*integrate_contact(self, parameters, mass, velocity)[:3])

    # Magnitudes of the contact, from the parameters of scenarios as NumPy arrays

    def undamped_peak_force(self, parameters: Any, mass: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the peak force [N] of the ideal contacts without damping, as an array (contacts, batch)."""
        import jax
        import jax.numpy as jnp

        from jaxhil.contact.ideal_contact_motion import integrate_contact

        shape = np.shape(parameters.stiffness)
        undamped = parameters._replace(damping=np.zeros_like(parameters.damping))
        m, v = (jnp.broadcast_to(jnp.asarray(values), shape) for values in (mass, velocity))
        motion = integrate_contact(self, jax.tree.map(jnp.asarray, undamped), m, v)
        return np.asarray(motion.peak_force)

    def tangent_stiffness(self, parameters: Any, mass: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the largest slope dF/dd [N/m] in each contact, an array (contacts, batch).

        By default, this is `parameters.stiffness`. For a segmented law, `parameters.stiffness` must already
        contain the largest slope of each contact.
        """
        return parameters.stiffness

    def onset_damping(self, parameters: Any) -> np.ndarray:
        """Return the damping constant dF/dd' [N s/m] at the onset of contact, an array (contacts, batch)."""
        return parameters.damping

    # Magnitudes of the contact, from a mechanism file

    def nominal_peak_force(self, contact: Any, stiffness: list[float], mass: float, velocity: float) -> float:
        """Estimate the largest peak force [N] of a mechanism's contacts. The default is a linear spring's."""
        return velocity * math.sqrt(max(stiffness) * mass)

    def damping_ratio(self, damping: float, mass: float, velocity: float, frequency: float) -> float:
        """Return the damping ratio [1] of the linear oscillator that loses as much energy as the contact.

        `frequency` is the contact frequency [rad/s], and `damping` an entry of the key `damping`.
        """
        return damping / (2 * mass * frequency)

    # Functions that a user's contact law may leave out

    def perturb_damping(
        self, drawn: Callable[[str], np.ndarray], ratio: np.ndarray, mass: np.ndarray, velocity: np.ndarray
    ) -> tuple[str, np.ndarray]:
        """Increase the contacts' energy loss by the loss of a linear oscillator with the damping ratio zeta.

        Args:
            drawn: function that returns the random draws of a key, (draws, ...). For `stiffness` and
                `damping` the shape is (draws, entries); for a segmented law, `stiffness` is the first slope.
            ratio: damping ratio zeta [1], (draws, 1).
            mass: equivalent mass [kg], (draws, 1).
            velocity: approach speed [m/s], (draws, 1).

        Returns:
            The key of `[contact]` that sets the dissipation, and its increased values.

        Raises:
            InputError: if the law has no parameter that increases its energy loss.
        """
        raise self._missing_method_error("perturb_damping")

    def as_float_law(self, contact: Any, stiffness: Any, damping: float) -> FloatLaw:
        """Return the law as functions of Python floats, for one entry of `stiffness` and one of `damping`.

        Raise `InputError` if the law does not define this method.
        """
        raise self._missing_method_error("as_float_law")

    def regression(self, contact: Any) -> Regression:
        """Return the law as a linear regression.

        Raise `InputError` if the law does not define this method.
        """
        raise self._missing_method_error("regression")

    def families(self, deepest: float, entries: int) -> list[RegressionFamily]:
        """Return the families of regressions that identification tries for this law; none by default.

        Args:
            deepest: largest penetration in the logs [m].
            entries: number of entries of the lists `stiffness` and `damping` that occur in the logs.
        """
        return []

    def coefficients(self, contact: Any, stiffness: Any, damping: float) -> list[float]:
        """Return the coefficients of `regression` for one contact, in the order of `Regression.names`."""
        return [stiffness, damping]

    def file_values(self, fitted: Mapping[str, np.ndarray], entry: int) -> dict[str, np.ndarray]:
        """Convert the fitted coefficients of one contact to values of a mechanism file.

        Args:
            fitted: values of the coefficients, by their names in `regression`.
            entry: index of the contact's entry in the lists `stiffness` and `damping`.

        Returns:
            Values by dotted key, such as "contact.stiffness.0".
        """
        return {f"contact.stiffness.{entry}": fitted["stiffness"]}

    def _missing_method_error(self, method: str) -> InputError:
        expected = f"a law that defines ContactLaw.{method}"
        return InputError(f"contact.law: found {format_value(self.name)}, expected {expected}")
