"""Numbers of a six-axis mechanism by dotted path, drawn or nominal, one per lane.

Computed numbers are NumPy arrays unless draws are JAX arrays; vectors, matrices and rotations consist of JAX
arrays.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import value_at
from jaxhil.sixdof.rotations import Quaternion, exponential
from jaxhil.sixdof.vectors import Matrix, Vector


class Values:
    """Arrays of shape (*entries, number): of NumPy, or of JAX if draws are."""

    def __init__(self, mechanism: SixAxisMechanism, draws: Mapping[str, Any]) -> None:
        # Namespace of the arrays: JAX or NumPy.
        self.np: Any = jnp if any(isinstance(drawn, jax.Array) for drawn in draws.values()) else np
        self.number = len(next(iter(draws.values()))) if draws else 1
        self._mechanism, self._draws = mechanism, draws

    def __call__(self, path: str, default: Any = None) -> Any:
        """Return the drawn value, else the nominal one or, without one in the file, the `default`."""
        value = self._draws.get(path)
        if value is None:
            nominal = value_at(self._mechanism, path)
            nominal = np.asarray(default if nominal is None else nominal, float)
            value = np.broadcast_to(nominal, (self.number, *nominal.shape))
        return self.np.moveaxis(self.np.asarray(value, float), 0, -1)

    def has(self, path: str) -> bool:
        """Return whether the file has a value."""
        return value_at(self._mechanism, path) is not None

    def drawn(self, path: str) -> bool:
        """Return whether the value is drawn."""
        return path in self._draws

    def nothing(self, path: str) -> bool:
        """Return whether the value is 0 in every lane."""
        return not self.drawn(path) and not np.any(np.asarray(value_at(self._mechanism, path), float))

    def constant(self, value: float) -> Any:
        """Return the same number in every lane."""
        return np.full(self.number, value)

    def inertia(self, path: str, default: Any = None) -> Any:
        """Return three moments, or three rows, as (3, 3, number)."""
        value = self(path, default)
        return value if value.ndim == 3 else np.eye(3)[:, :, None] * value[None]

    def rotation(self, theta: Any) -> Quaternion:
        """Return the rotation for rotation vectors (3, number)."""
        if self.np is jnp:
            return exponential(self.vector(theta))
        half = np.sqrt((theta**2).sum(axis=0)) / 2
        return Quaternion(jnp.asarray(np.cos(half)), self.vector(np.sinc(half / np.pi) / 2 * theta))

    def vector(self, values: Any) -> Vector:
        """Return a vector of components (3, number)."""
        return Vector(*(jnp.asarray(part) for part in values))

    def matrix(self, values: Any) -> Matrix:
        """Return a matrix of rows (3, 3, number)."""
        return Matrix(*(self.vector(row) for row in values))

    def turned(self, angle: Any, axis: Any) -> Any:
        """Return points (3, number), rotated about z by an angle [rad]."""
        cosine, sine = self.np.cos(angle), self.np.sin(angle)
        x, y, z = axis
        return self.np.stack([cosine * x - sine * y, sine * x + cosine * y, z])

    def direction(self, values: Any) -> Vector:
        """Return the unit vector along (3, number)."""
        return self.vector(values / self.np.sqrt((values**2).sum(axis=0)))
