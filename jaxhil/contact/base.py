"""What a contact law is: the force of a docking mechanism against penetration d > 0 and its rate d'.

A law is a pure function of the motion and of a state of its own (`init`, `step`); that of a memoryless law is
empty. All forces are zero for d <= 0 and, unless tension is allowed, never negative. Shapes: every argument
broadcasts to the batch shape; slopes and depths of the piecewise-linear law carry a leading axis of segments.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from jaxhil.contact.reference import Reference
from jaxhil.contact.reference_motion import integrate_contact


class ContactParameters(NamedTuple):
    """What a law needs of one contact; a leading axis of contacts, where there is one, comes first."""

    # [N/m], or [N/m^n] with an exponent n; (segments, ...) for piecewise-linear
    stiffness: Float[Array, "..."]
    damping: Float[Array, "..."]  # [N s/m], or chi [s/m] for Hunt-Crossley
    exponent: Float[Array, "..."]  # n [1]
    depths: Float[Array, "..."]  # between segments [m], (segments - 1, ...)
    tension: Bool[Array, "..."]  # whether the contact may pull
    reference_depth: Float[Array, "..."]  # d_0 [m]
    unloading_ratio: Float[Array, "..."]  # r [1]
    preload: Float[Array, "..."]  # F_0 [N]
    friction: Float[Array, "..."]  # F_r [N]
    kind: Int[Array, "..."] | None = None  # number of the law for `jaxhil.contact.mixture`, else None


class ContactLaw(eqx.Module):
    """Interface of all contact laws. A law holds no arrays: all numbers come with the parameters."""

    # What mechanism files call a law that `jaxhil.register` enters; the built-in ones are entered by name.
    name: ClassVar[str] = ""

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

    def init(self, penetration: Array) -> tuple[Array, ...]:
        """State before the first touch, for a batch shaped like `penetration`."""
        return ()

    @abc.abstractmethod
    def step(
        self, parameters: ContactParameters, state: tuple[Array, ...], penetration: Array, rate: Array
    ) -> tuple[Array, tuple[Array, ...]]:
        """Force [N] at `penetration` [m] and `rate` [m/s], and the next state."""

    @abc.abstractmethod
    def edge(self, parameters: ContactParameters, rate: Array) -> Array:
        """Limit of the force [N] as the penetration goes to 0 from above: the jump of a damped touch."""

    @abc.abstractmethod
    def hold(
        self, parameters: ContactParameters, state: tuple[Array, ...], penetration: Array, rate: Array
    ) -> Array:
        """Smooth and positive as long as penetrated surfaces hold on to each other, else not: they let go
        where it goes through 0. The force before its clamp, or anything of its sign."""

    def corners(self, parameters: ContactParameters, state: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return the penetrations [m] at which the slope of the force changes; by default there are none."""
        return ()

    def reference(self, parameters: ContactParameters, mass: Array, velocity: Array) -> Reference:
        """The same contact in space, entered at `velocity` [m/s]: see `jaxhil.contact.reference`. By default
        its motion is integrated (`jaxhil.contact.reference_motion`)."""
        return Reference(*integrate_contact(self, parameters, mass, velocity)[:3])
