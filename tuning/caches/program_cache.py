"""Cache of traced programs on disk, in addition to the compiler's cache.

Tracing a solver takes longer than running it. `run_program` stores the traced program in a file whose name is
a digest of everything it depends on: sources, versions of the dependencies, static arguments and shapes. The
file is sealed, because a damaged program could crash the process that reads it, or give wrong results.
"""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from jaxhil.files import read_checksummed, remove_stale, write_checksummed
from jaxhil.simulation import cached_programs
from jaxhil.simulation.cached_programs import has_user_objects
from jaxhil.simulation.jax_environment import TICK_OPTIONS, supported_options
from jaxhil.simulation.source_fingerprint import dependency_versions, sources_sha256

# JAX does not guarantee that calls of LAPACK are stable between versions; the file's name has the version.
LAPACK_TARGETS = ("lapack_dpotrf_ffi", "lapack_dtrsm_ffi")


def run_program(
    function: Callable[..., Any], static: Any, arguments: Any, folder: str | os.PathLike[str] | None
) -> Any:
    """Return `function(static, arguments)`, a named tuple of arrays, from the cached or compiled program.

    Args:
        function: function at the top of a module, with an annotated result.
        static: hashable constants of the program, which their `repr` must describe completely.
        arguments: pytree of arrays.
        folder: folder of the cache, or None. Programs with user-registered compensators or contact laws are
            not stored, since their sources are unknown.
    """
    program, leaves = _look_up(function, static, arguments, folder)
    return function.__annotations__["return"](*program(*leaves))


def prepare_program(
    function: Callable[..., Any], static: Any, arguments: Any, folder: str | os.PathLike[str] | None
) -> None:
    """Trace and compile the program of `run_program` into `folder` and the compiler's cache."""
    program, leaves = _look_up(function, static, arguments, folder)
    cached_programs.compile_program(program, leaves)


def _look_up(function, static, arguments, folder):
    """Return the program and the flat arguments."""
    leaves, structure = jax.tree.flatten(arguments)
    shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
    return _load_or_build_program(
        function, static, structure, shapes, None if has_user_objects(static) else folder
    ), leaves


@cache
def _load_or_build_program(function, static, structure, shapes, folder):
    """Return the program of `run_program`, a function from flat arrays to flat arrays."""

    def flat(*leaves):
        return tuple(function(static, jax.tree.unflatten(structure, leaves)))

    if folder is None:
        return jax.jit(flat, compiler_options=supported_options(TICK_OPTIONS))
    name = _compute_program_digest(function, static, structure, shapes)
    like = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    return cached_programs.load_or_compile(
        name, partial(_trace_program, name, flat, like, folder), like, folder
    )


def _trace_program(name, flat, like, folder):
    """Return the jitted program from the file of this name, or trace `flat` and write the file."""
    path = Path(folder) / f"{name}.program"
    exported = _read_program(path)
    if exported is None:
        checks = [export.DisabledSafetyCheck.custom_call(name) for name in LAPACK_TARGETS]
        exported = export.export(jax.jit(flat), disabled_checks=checks)(*like)
        _write_program(path, exported.serialize())
    compiled = partial(jax.jit, compiler_options=supported_options(TICK_OPTIONS))
    if exported.nr_devices == 1:
        return compiled(exported.call)
    devices = jax.devices()[: exported.nr_devices]
    mesh = jax.make_mesh((len(devices),), ("device",), axis_types=(AxisType.Auto,), devices=devices)
    return compiled(exported.call, in_shardings=NamedSharding(mesh, PartitionSpec()))


def _compute_program_digest(function, static, structure, shapes) -> str:
    """Return the digest of everything that a program depends on."""
    float_type = jnp.result_type(float).name
    flags = float_type, jax.default_backend(), jax.device_count()
    inputs = static, structure, shapes, dependency_versions(), flags
    text = repr((function.__module__, function.__qualname__, sources_sha256(), *inputs))
    return hashlib.sha256(text.encode()).hexdigest()


def _read_program(path: Path) -> export.Exported | None:
    """Return the program in a file, or None if there is none or it cannot be read."""
    content = read_checksummed(path)
    try:
        return None if content is None else export.deserialize(bytearray(content))
    except Exception:
        # The file is intact, but its content is no program.
        return None


def _write_program(path: Path, content: bytes | bytearray) -> None:
    """Write a program; errors are ignored, because they only make the next call slower."""
    with suppress(OSError):
        remove_stale(path.parent)
        write_checksummed(path, content, lasting=False)
