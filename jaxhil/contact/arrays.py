"""Lazy import of `jax.numpy` for the contact laws, so that mechanism files are read without JAX."""

from typing import TYPE_CHECKING, Any

__all__ = ["jnp"]


class _LazyNumpy:
    """Proxy of `jax.numpy`: the first use of an attribute imports the module."""

    def __getattr__(self, name: str) -> Any:
        import jax.numpy

        return getattr(jax.numpy, name)


if TYPE_CHECKING:
    import jax.numpy as jnp
else:
    jnp = _LazyNumpy()
