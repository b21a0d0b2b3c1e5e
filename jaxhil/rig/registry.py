"""Interface of the rig's compensators, and the table `COMPENSATORS` of registered compensators.

A compensator is a class with the methods of `Compensator`, and may inherit the default methods.
`@register(name)` adds the class to the table; gain files refer to the compensator by this name.
"""

from collections.abc import Callable, Mapping
from math import inf
from typing import ClassVar, NamedTuple, Protocol, TypeVar

from jaxhil.rig.law_status import UNSTATED
from jaxhil.rig.types import Gains, Positive


class GainSpecification(NamedTuple):
    """Unit and absolute bounds of a gain; these bounds apply in addition to those in a gain file."""

    unit: str  # "1" if dimensionless
    lowest: float = -inf  # lower bound
    highest: float = inf  # upper bound

    def admits(self, value: float) -> bool:
        """Return whether the value is within the bounds."""
        return self.lowest <= value <= self.highest


class Compensator(Protocol):
    """Interface of a compensator, which the controller calls once per tick.

    Args:
        gains: gains by name, in SI units.
        period: control period [s].
        clearance: clearance of a two-sided contact [m]; infinite for a one-sided one.
    """

    __slots__ = ()

    gains: ClassVar[Mapping[str, GainSpecification]]
    # Status of the last command, a number of `law_status`. A compensator without a status has UNSTATED.
    status: int = UNSTATED

    def __init__(self, gains: Gains, period: Positive, clearance: float) -> None: ...

    @property
    def identified(self) -> tuple[float, float]:
        """Return the identified stiffness [N/m] and damping [N s/m]; (0, 0) if nothing is identified."""
        return 0.0, 0.0

    @property
    def force_delay(self) -> float:
        """Return the estimated delay [s] of the force measurement; 0 if none is estimated."""
        return 0.0

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
    ) -> float:
        """Return the force F_c [N] on the numerical model; all arguments are finite, in N, m and m/s."""
        ...

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """Return the position command [m] for the numerical model's new motion [m, m/s, m/s^2]."""
        return position

    def reset(self) -> None:
        """Restart everything, including the identified parameters."""

    def next_contact(self) -> None:
        """Restart filters, delay lines and the parameters' covariance; keep the identified parameters."""
        self.reset()


AnyCompensator = TypeVar("AnyCompensator", bound=type[Compensator])

COMPENSATORS: dict[str, type[Compensator]] = {}


def register(name: str) -> Callable[[AnyCompensator], AnyCompensator]:
    """Return a class decorator that adds a compensator to `COMPENSATORS` under `name`."""

    def decorate(compensator: AnyCompensator) -> AnyCompensator:
        COMPENSATORS[name] = compensator
        return compensator

    return decorate
