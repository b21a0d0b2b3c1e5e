"""Drawn or nominal values of a six-axis mechanism by dotted path, as arrays with one entry per lane.

The arrays are JAX arrays if the draws are JAX arrays, else NumPy arrays. Vectors, matrices and rotations
always consist of JAX arrays.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.sixdof.rotations import Quaternion, exponential
from jaxhil.sixdof.vectors import Matrix, Vector


class DrawnValues:
    """Drawn or nominal values of a mechanism, as arrays (*entries, lanes) of NumPy or JAX."""

    def __init__(self, mechanism: SixAxisMechanism, draws: Mapping[str, Any]) -> None:
        # Array library: `jax.numpy` or `numpy`.
        self.np: Any = jnp if any(isinstance(drawn, jax.Array) for drawn in draws.values()) else np
        self.number = len(next(iter(draws.values()))) if draws else 1
        self._mechanism, self._draws = mechanism, draws

    def __call__(self, path: str, default: Any = None) -> Any:
        """Return the drawn values for a `path`, else the nominal value, else `default`."""
        value = self._draws.get(path)
        if value is None:
            nominal = value_at(self._mechanism, path)
            nominal = np.asarray(default if nominal is None else nominal, float)
            value = np.broadcast_to(nominal, (self.number, *nominal.shape))
        return self.np.moveaxis(self.np.asarray(value, float), 0, -1)

    def has_value(self, path: str) -> bool:
        """Return whether the file has a value for this path."""
        return value_at(self._mechanism, path) is not None

    def is_drawn(self, path: str) -> bool:
        """Return whether the value for this path is drawn."""
        return path in self._draws

    def is_zero(self, path: str) -> bool:
        """Return whether the value is 0 in all scenarios: 0 in the file, and not drawn."""
        return not self.is_drawn(path) and not np.any(np.asarray(value_at(self._mechanism, path), float))

    def optional(self, path: str) -> Any:
        """Return the values of a parameter; None if it is 0 in every draw."""
        is_used = path in self._draws or path in self._mechanism.uncertainty
        return self(path) if is_used or value_at(self._mechanism, path) else None

    def constant(self, value: float) -> Any:
        """Return an array (lanes,) with the same number in every lane."""
        return np.full(self.number, value)

    def inertia(self, path: str, default: Any = None) -> Any:
        """Return an inertia as matrices (3, 3, lanes), from three moments (the diagonal) or three rows."""
        value = self(path, default)
        return value if value.ndim == 3 else np.eye(3)[:, :, None] * value[None]

    def rotation(self, theta: Any) -> Quaternion:
        """Convert rotation vectors (3, lanes) [rad] to rotations."""
        if self.np is jnp:
            return exponential(self.vector(theta))
        half = np.sqrt((theta**2).sum(axis=0)) / 2
        return Quaternion(jnp.asarray(np.cos(half)), self.vector(np.sinc(half / np.pi) / 2 * theta))

    def vector(self, values: Any) -> Vector:
        """Convert components (3, lanes) to a `Vector`."""
        return Vector(*(jnp.asarray(part) for part in values))

    def matrix(self, values: Any) -> Matrix:
        """Convert rows (3, 3, lanes) to a `Matrix`."""
        return Matrix(*(self.vector(row) for row in values))

    def rotated_about_z(self, angle: Any, axis: Any) -> Any:
        """Rotate points or axes (3, lanes) about z by an angle [rad]."""
        cosine, sine = self.np.cos(angle), self.np.sin(angle)
        x, y, z = axis
        return self.np.stack([cosine * x - sine * y, sine * x + cosine * y, z])

    def direction(self, values: Any) -> Vector:
        """Convert components (3, lanes) to a `Vector` of length 1."""
        return self.vector(values / self.np.sqrt((values**2).sum(axis=0)))
