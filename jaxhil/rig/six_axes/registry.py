"""Interface of the rig's six-axis compensators, and the table of registered compensators.

A compensator is a class with the methods of `SixAxisCompensator`, and may inherit the default methods.
`@register_six_axes(name)` adds the class to the table; gain files refer to the compensator by this name.
"""

from collections.abc import Callable, Mapping
from typing import ClassVar, NamedTuple, Protocol, TypeVar

from jaxhil.rig.law_status import OUT_OF_CONTACT, UNSTATED
from jaxhil.rig.registry import GainSpecification
from jaxhil.rig.six_axes.vectors import Matrix, Vector
from jaxhil.rig.types import Gains, Positive


class ModelConstants(NamedTuple):
    """Constants of the numerical model and of the rig, as stored in a six-axis gain file."""

    mass_matrix: Matrix  # relative mass matrix M at the docked pose, about C's origin [kg, kg m, kg m^2]
    inverse_mass: Matrix  # inverse of M
    # (1 - M_t M^-1)^-1, converts a reading to the contact's wrench, about C's origin; identity without a tool
    tool_correction: Matrix
    longest_delay: float  # upper bound of the loop's delay [s]
    sensor_sign: float  # 1 for a force sensor that carries the tool, -1 for one on the target's side
    # weight of the tool on the force sensor, in T axes [N], and its centre of mass, in C axes [m]; or zeros
    tool_load: Vector


class SixAxisCompensator(Protocol):
    """Interface of a six-axis compensator, which the controller calls once per tick.

    Args:
        gains: gains by name, in SI units.
        constants: constants of the numerical model and the rig.
        period: control period [s].
    """

    __slots__ = ()

    gains: ClassVar[Mapping[str, GainSpecification]]
    # Status at the last command, a number of `law_status`. A compensator without a status has UNSTATED.
    status: int = UNSTATED

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None: ...

    @property
    def loop_delay(self) -> float:
        """Return the hardware's delay [s] relative to the model in the last contact; 0 if unknown."""
        return 0.0

    @property
    def unpaid_impulse(self) -> float:
        """Return the remaining impulse error after a contact, as a share of the contact's impulse [1].

        The share is 0 if the compensator does not know it.
        """
        return 0.0

    @property
    def is_acting(self) -> bool:
        """Return whether the status says that the compensator acts on a contact; False without a status."""
        return self.status not in (UNSTATED, OUT_OF_CONTACT)

    def step(
        self, wrench: Vector, pose_desired: Vector, twist_desired: Vector, pose_measured: Vector
    ) -> Vector:
        """Return the wrench on the numerical model about T's origin [N, N m]; all arguments are finite.

        Args:
            wrench: measured wrench on the chaser about T's origin [N, N m].
            pose_desired: pose of chaser frame C relative to target frame T in the model [m, rad].
            twist_desired: twist of C relative to T in the numerical model [m/s, rad/s].
            pose_measured: measured pose of C relative to T on the hardware [m, rad].
        """
        ...

    def pose_command(self, pose: Vector, rates: Vector) -> Vector:
        """Return the pose command [m, rad] for the model's new coordinates and their rates."""
        return list(pose)

    def reset(self) -> None:
        """Restart filters, delay lines and estimates."""

    def next_contact(self) -> None:
        """Restart filters and delay lines for the next run."""
        self.reset()


AnySixAxisCompensator = TypeVar("AnySixAxisCompensator", bound=type[SixAxisCompensator])

SIX_AXIS_COMPENSATORS: dict[str, type[SixAxisCompensator]] = {}


def register_six_axes(name: str) -> Callable[[AnySixAxisCompensator], AnySixAxisCompensator]:
    """Return a class decorator that adds a compensator to `SIX_AXIS_COMPENSATORS` under `name`."""

    def enter(compensator: AnySixAxisCompensator) -> AnySixAxisCompensator:
        SIX_AXIS_COMPENSATORS[name] = compensator
        return compensator

    return enter
