"""Lazy import of `jax.numpy` for the contact laws, so that mechanism files are read without JAX."""

from typing import TYPE_CHECKING, Any

__all__ = ["jnp"]


class _LazyNumpy:
    """Stand-in for `jax.numpy` that imports it when an attribute is first used."""

    def __getattr__(self, name: str) -> Any:
        import jax.numpy

        return getattr(jax.numpy, name)


if TYPE_CHECKING:
    import jax.numpy as jnp
else:
    jnp = _LazyNumpy()
