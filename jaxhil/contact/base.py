"""Interface of the contact laws: the force of a docking mechanism against penetration d > 0 and its rate d'.

A law states all that depends on it: the keys of a mechanism file that it uses, its force in the simulation
and in plain floats, its ideal contact, and what tuning, benchmarks and identification need of it. A new law
is one file with a class and one entry in `jaxhil.contact.laws`.

In the simulation a law is a pure function of the motion and of a state of its own (`init`, `step`); the state
of a memoryless law is empty. All forces are zero for d <= 0 and, unless tension is allowed, never negative.
Every argument broadcasts to the batch shape; slopes and depths of a segmented law carry a leading axis of
segments. Arrays are those of `jax.numpy` where nothing else is said.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, dataclass_transform

import numpy as np

from jaxhil.contact.float_law import FloatLaw
from jaxhil.contact.keys import Key
from jaxhil.contact.regression import Family, Regression
from jaxhil.errors import InputError, shown

if TYPE_CHECKING:
    from jaxhil.contact.reference import Reference

__all__ = ["ContactLaw"]


@dataclass_transform(frozen_default=True)
class ContactLaw(abc.ABC):
    """Interface of all contact laws.

    A subclass is a frozen dataclass and holds no arrays: all numbers come with the parameters
    (`jaxhil.contact.laws.ContactParameters`) or with the file's table `[contact]`, here called `contact`.
    """

    name: ClassVar[str] = ""  # in mechanism files
    # Keys of some laws alone that this one uses; None: it does not say, and may use any of them.
    keys: ClassVar[tuple[Key, ...] | None] = None
    stiffness_unit: ClassVar[str] = "N/m"
    damping_unit: ClassVar[str] = "N s/m"
    damped: ClassVar[bool] = True  # whether the force depends on the key `damping`
    dissipates_by: ClassVar[str] = ""  # of a law that refuses the key `damping`: what dissipates instead
    segmented: ClassVar[bool] = False  # whether each entry of `stiffness` is a list of slopes
    is_linear: ClassVar[bool] = False  # whether the force in contact is k d + b d'
    damped_as: ClassVar[str] = ""  # name of the law that it is with damping; empty: its own

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Make the subclass a frozen dataclass: programs are compiled for a law, which has to be hashable."""
        super().__init_subclass__(**kwargs)
        dataclass(frozen=True)(cls)

    # The simulation

    @property
    def remembers(self) -> bool:
        """Whether the force depends on how deep the mechanism has been: state and motion are then followed
        between samples too. Where there is no penetration the state is that before the first touch: a
        surface that has been left is as new. Of the way between two penetrations only the deepest counts."""
        return False

    @property
    def jumps(self) -> bool:
        """Whether the force jumps where the motion turns: its peak is then looked for between samples."""
        return False

    @property
    def arcs(self) -> bool:
        """Tell whether in contact the force over a quarter of a slow interval is close to a parabola:
        no slope that changes at a depth, no jump at a turn, no end at a power of the depth."""
        return False

    @property
    def closed_form(self) -> bool:
        """Whether the reference is quick enough to be worked out with every run; else it is integrated."""
        return type(self).reference is not ContactLaw.reference

    @property
    def simulated(self) -> ContactLaw:
        """The law that computes the same force in the simulation: laws of two names share its programs."""
        return self

    def specialised(self, contact: Any, drawn: Callable[[str], bool]) -> ContactLaw:
        """Return the law for numbers that all batch elements share; `drawn` tells of a key if they do not."""
        return self.simulated

    def init(self, penetration: Any) -> tuple[Any, ...]:
        """Return the state before the first touch, for a batch shaped like `penetration`."""
        return ()

    @abc.abstractmethod
    def step(
        self, parameters: Any, state: tuple[Any, ...], penetration: Any, rate: Any
    ) -> tuple[Any, tuple[Any, ...]]:
        """Return the force [N] at `penetration` [m] and `rate` [m/s], and the next state."""

    @abc.abstractmethod
    def edge(self, parameters: Any, rate: Any) -> Any:
        """Return the limit of the force [N] as the penetration goes to 0 from above: the jump of a damped
        touch."""

    @abc.abstractmethod
    def hold(self, parameters: Any, state: tuple[Any, ...], penetration: Any, rate: Any) -> Any:
        """Return a smooth function that is positive as long as penetrated surfaces hold on to each other:
        they let go where it goes through 0. It is the force before its clamp, or anything of its sign."""

    def corners(self, parameters: Any, state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return the penetrations [m] at which the slope of the force changes; by default there are none."""
        return ()

    def reference(self, parameters: Any, mass: Any, velocity: Any) -> Reference:
        """Return the ideal contact entered at `velocity` [m/s] (`jaxhil.contact.reference`). By default its
        motion is integrated (`jaxhil.contact.reference_motion`)."""
        from jaxhil.contact.reference import Reference
        from jaxhil.contact.reference_motion import integrate_contact

        return Reference(*integrate_contact(self, parameters, mass, velocity)[:3])

    # Scales of the contact, from the numbers of scenarios as NumPy arrays

    def undamped_peak_force(self, parameters: Any, mass: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the peak force [N] of each contact if it had no damping, (slots, batch). By default the
        motion is integrated."""
        import jax
        import jax.numpy as jnp

        from jaxhil.contact.reference_motion import integrate_contact

        shape = np.shape(parameters.stiffness)
        undamped = parameters._replace(damping=np.zeros_like(parameters.damping))
        entered = [jnp.broadcast_to(jnp.asarray(one), shape) for one in (mass, velocity)]
        motion = integrate_contact(self, jax.tree.map(jnp.asarray, undamped), entered[0], entered[1])
        return np.asarray(motion.peak_force)

    def tangent_stiffness(self, parameters: Any, mass: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the largest slope of the force against the depth [N/m], (slots, batch). By default it is the
        stiffness. Of a segmented law the parameters have the largest slope alone."""
        return parameters.stiffness

    def onset_damping(self, parameters: Any) -> np.ndarray:
        """Return the slope of the force against the rate at the touch [N s/m], (slots, batch)."""
        return parameters.damping

    # Scales of the contact, from a mechanism file

    def nominal_peak_force(self, contact: Any, stiffness: list[float], mass: float, velocity: float) -> float:
        """Return the order of the peak force [N] over the entries of `stiffness`, as of a linear contact."""
        return velocity * math.sqrt(max(stiffness) * mass)

    def damping_ratio(self, damping: float, mass: float, velocity: float, frequency: float) -> float:
        """Return the damping ratio [1] of an oscillator of this `frequency` [rad/s] that loses as much."""
        return damping / (2 * mass * frequency)

    # What other parts need of a law, which a law may leave out

    def perturb_damping(
        self, drawn: Callable[[str], np.ndarray], ratio: np.ndarray, mass: np.ndarray, velocity: np.ndarray
    ) -> tuple[str, np.ndarray]:
        """Return a key and its values with the dissipation added of an oscillator of this damping ratio.

        Args:
            drawn: function of a key that returns its draws, (draws, ...); of `stiffness` and `damping`
                (draws, entries), the first slope of a segmented law.
            ratio: damping ratio [1], (draws, 1).
            mass: equivalent mass [kg], (draws, 1).
            velocity: approach speed [m/s], (draws, 1).

        Raises:
            InputError: if the law does not state how it dissipates.
        """
        raise self._unstated("whose damping can be perturbed", "perturb_damping")

    def in_floats(self, contact: Any, stiffness: Any, damping: float) -> FloatLaw:
        """Return the law in plain floats, with these entries of the lists. Raise `InputError` if there is
        none."""
        raise self._unstated("in plain floats", "in_floats")

    def regression(self, contact: Any) -> Regression:
        """Return the law as a sum of known functions. Raise `InputError` if it is none."""
        raise self._unstated("that is fitted to logs", "regression")

    def families(self, deepest: float, entries: int) -> list[Family]:
        """Return the regressions that identification tries on logs whose deepest touch is `deepest` [m] and
        that meet so many entries of the lists; none by default."""
        return []

    def coefficients(self, contact: Any, stiffness: Any, damping: float) -> list[float]:
        """Return the coefficients of `regression`, those of an entry and then the shared ones."""
        return [stiffness, damping]

    def file_values(self, fitted: Mapping[str, np.ndarray], entry: int) -> dict[str, np.ndarray]:
        """Return values by key of the mechanism file from the coefficients of an entry, `fitted` by name."""
        return {f"contact.stiffness.{entry}": fitted["stiffness"]}

    def _unstated(self, which: str, method: str) -> InputError:
        expected = f"a law {which} (ContactLaw.{method})"
        return InputError(f"contact.law: found {shown(self.name)}, expected {expected}")
