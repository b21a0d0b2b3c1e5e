"""`jax.numpy`, imported when a contact law first computes with arrays: files are read without JAX."""

from typing import TYPE_CHECKING, Any

__all__ = ["jnp"]


class _LazyNumpy:
    """Stand-in for `jax.numpy` that imports it at the first access."""

    def __getattr__(self, name: str) -> Any:
        import jax.numpy

        return getattr(jax.numpy, name)


if TYPE_CHECKING:
    import jax.numpy as jnp
else:
    jnp = _LazyNumpy()
