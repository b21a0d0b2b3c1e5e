"""What a compensator of the runtime is, and the table of those known.

A compensator is a class with the methods of `Compensator`, from which it may take those that do nothing of
their own; `@register(name)` enters it under the name that gain files use.
"""

from collections.abc import Callable, Mapping
from math import inf
from typing import ClassVar, NamedTuple, Protocol, TypeVar

from jaxhil.rig.law_status import UNSTATED
from jaxhil.rig.types import Gains, Positive


class GainSpecification(NamedTuple):
    """One gain of a compensator: its unit, and the bounds that no gain file can move (`bounds`); the narrower
    ones used in tuning stand in the gain file itself."""

    unit: str  # "1" if it has none
    lowest: float = -inf  # least value
    highest: float = inf  # largest value

    def admits(self, value: float) -> bool:
        """Whether the value is within the bounds."""
        return self.lowest <= value <= self.highest


class Compensator(Protocol):
    """One compensation law, as it is evaluated tick by tick.

    Constructed from its gains by name (SI units), the control period [s] and the clearance [m] of a
    two-sided contact (infinite when the contact is one-sided).
    """

    __slots__ = ()

    gains: ClassVar[Mapping[str, GainSpecification]]
    # What stands behind the last command, one of `law_status`; a law says so always or never.
    status: int = UNSTATED

    def __init__(self, gains: Gains, period: Positive, clearance: float) -> None: ...

    @property
    def identified(self) -> tuple[float, float]:
        """Identified stiffness [N/m] and damping [N s/m]; (0, 0) if the law identifies none."""
        return 0.0, 0.0

    @property
    def force_delay(self) -> float:
        """Estimated delay [s] of the force measurement; 0 if the law estimates none."""
        return 0.0

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
    ) -> float:
        """The force [N] that the numerical model is to feel, from this tick's finite readings."""
        ...

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """The position [m] to command, from the numerical model's new motion; its position itself unless the
        law says otherwise."""
        return position

    def reset(self) -> None:
        """Restart everything, identified parameters included; nothing, where a law has no state."""

    def next_contact(self) -> None:
        """Restart filters, delay lines and covariance; keep the identified parameters, if there are any."""
        self.reset()


AnyCompensator = TypeVar("AnyCompensator", bound=type[Compensator])

COMPENSATORS: dict[str, type[Compensator]] = {}


def register(name: str) -> Callable[[AnyCompensator], AnyCompensator]:
    """A class decorator that enters a compensator in `COMPENSATORS` under `name`."""

    def enter(compensator: AnyCompensator) -> AnyCompensator:
        COMPENSATORS[name] = compensator
        return compensator

    return enter
