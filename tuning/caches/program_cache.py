"""Programs kept between calls: what tracing made of a function, beside what the compiler made of it.

Tracing a solve takes longer than running it. `run` keeps the traced program in a file whose name is made of
all it depends on: the sources, the versions of what they stand on, static arguments, shapes. The file is
sealed: a bit that flipped in it could crash the process that reads it, or change what it computes.
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

from jaxhil.files import read_sealed, remove_stale, write_sealed
from jaxhil.simulation import kept_programs
from jaxhil.simulation.environment import TICKS, known_options
from jaxhil.simulation.kept_programs import is_foreign
from jaxhil.simulation.sources import sources_sha256, versions

# Calls into LAPACK have no promise to mean the same in other versions; the name has the version in it.
LAPACK = ("lapack_dpotrf_ffi", "lapack_dtrsm_ffi")


def run(
    function: Callable[..., Any], static: Any, arguments: Any, folder: str | os.PathLike[str] | None
) -> Any:
    """`function(static, arguments)`, a named tuple of arrays, compiled.

    `function` is one of a module, with an annotated result. `static` is hashable, and its `repr` tells all of
    it; `arguments` is a pytree of arrays. Programs are kept in `folder`; none without one, and none of
    compensators or contact laws from elsewhere, whose sources are not known.
    """
    program, leaves = _look_up(function, static, arguments, folder)
    return function.__annotations__["return"](*program(*leaves))


def prepare(
    function: Callable[..., Any], static: Any, arguments: Any, folder: str | os.PathLike[str] | None
) -> None:
    """Trace and compile what `run` will run on such arguments, into `folder` and the compile cache."""
    program, leaves = _look_up(function, static, arguments, folder)
    kept_programs.make(program, leaves)


def _look_up(function, static, arguments, folder):
    leaves, structure = jax.tree.flatten(arguments)
    shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
    return _program(function, static, structure, shapes, None if is_foreign(static) else folder), leaves


@cache
def _program(function, static, structure, shapes, folder):
    """The program of `run`, from and to flat arrays."""

    def flat(*leaves):
        return tuple(function(static, jax.tree.unflatten(structure, leaves)))

    if folder is None:
        return jax.jit(flat, compiler_options=known_options(TICKS))
    name = _name(function, static, structure, shapes)
    like = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    return kept_programs.compiled(name, partial(_traced, name, flat, like, folder), like, folder)


def _traced(name, flat, like, folder):
    path = Path(folder) / f"{name}.program"
    exported = _read(path)
    if exported is None:
        checks = [export.DisabledSafetyCheck.custom_call(name) for name in LAPACK]
        exported = export.export(jax.jit(flat), disabled_checks=checks)(*like)
        _write(path, exported.serialize())
    compiled = partial(jax.jit, compiler_options=known_options(TICKS))
    if exported.nr_devices == 1:
        return compiled(exported.call)
    devices = jax.devices()[: exported.nr_devices]
    mesh = jax.make_mesh((len(devices),), ("device",), axis_types=(AxisType.Auto,), devices=devices)
    return compiled(exported.call, in_shardings=NamedSharding(mesh, PartitionSpec()))


def _name(function, static, structure, shapes) -> str:
    wide = jnp.result_type(float).name
    flags = wide, jax.default_backend(), jax.device_count()
    made_of = static, structure, shapes, versions(), flags
    text = repr((function.__module__, function.__qualname__, sources_sha256(), *made_of))
    return hashlib.sha256(text.encode()).hexdigest()


def _read(path: Path) -> export.Exported | None:
    """The program kept in a file; None if there is none, or none that can be read."""
    content = read_sealed(path)
    try:
        return None if content is None else export.deserialize(bytearray(content))
    except Exception:
        # Written whole, but by something else.
        return None


def _write(path: Path, content: bytes | bytearray) -> None:
    """All or nothing; a folder that has become full or read-only costs only the next call's time."""
    with suppress(OSError):
        remove_stale(path.parent)
        write_sealed(path, content, lasting=False)
