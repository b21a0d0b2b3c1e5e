"""Cache of compiled programs across processes, which avoids both tracing and lowering.

Tracing and lowering take longer than running a short batch. JAX's description of a compiled program is stored
in a file, whose name is the hash of everything that determines it: sources, versions of dependencies, static
arguments, shapes, settings of JAX, compiler flags and options, and processor. The machine code stays in the
compile cache, and the file contains its key there: JAX can serialise machine code completely, but code that
it has itself deserialised fails after another serialisation. As with the compile cache, anyone who may write
into the folder may run code in the process that reads it: checksums protect against damage, not against
malicious files.

Some functions of JAX used here are private. If one is missing, and on graphics cards, nothing is cached.
"""

import dataclasses
import hashlib
import io
import os
import pickle
import re
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax

from jaxhil.files import read_checksummed, remove_stale, write_checksummed
from jaxhil.simulation import compile_cache
from jaxhil.simulation.jax_environment import (
    active_xla_flags,
    program_folder,
    rounding_flags,
    supported_options,
)
from jaxhil.simulation.source_fingerprint import OWN_PACKAGES, dependency_versions, sources_sha256

PROGRAM_SUFFIX = ".compiled"  # suffix of the file names
READ_TIME_EVENT = (
    "/jax/compilation_cache/cache_retrieval_time_sec"  # JAX's name for the time of reading a program
)
MACHINE_CODE_TAG = "exec"  # JAX's tag of machine code in its pickles
# Calls that a program may contain: of LAPACK, which is initialised before the program is used, and
# annotations of the arrays' placement. Any other call may refer to a function of the writing process.
CACHEABLE_CALLS = re.compile(r"lapack_\w+|Sharding|SPMD\w+|xla\.sdy\.\w+")

Options = Mapping[str, int | str]  # of the compiler, by name
NO_OPTIONS: Options = MappingProxyType({})

_programs: dict[Any, Any] = {}  # programs of this process


def run_cached(
    function: Callable[..., Any], static: Any, *arguments: Any, options: Options = NO_OPTIONS
) -> Any:
    """Return `function(static, *arguments)`, compiled with the compiler's `options`.

    `function` is defined at the top of a module; its result consists of arrays, tuples and named tuples.
    `static` is hashable, and its `repr` describes it completely. `arguments` are pytrees of arrays; arrays of
    equal shape have equal placement. Programs are cached on disk unless they contain user-registered laws.
    """
    program, leaves = _find_program(function, static, arguments, options)
    return program(*leaves)


def compile_cached(
    function: Callable[..., Any], static: Any, *arguments: Any, options: Options = NO_OPTIONS
) -> None:
    """Compile the program that `run_cached` will use for these arguments."""
    program, leaves = _find_program(function, static, arguments, options)
    if not isinstance(program, jax.stages.Compiled):
        program.lower(*leaves).compile()


def _find_program(function, static, arguments, options):
    """Return the program for these arguments, and their leaves."""
    leaves, structure = jax.tree.flatten(arguments)
    folder = program_folder()
    shapes = tuple([(leaf.shape, leaf.dtype) for leaf in leaves])
    key = function, static, structure, shapes, frozenset(options.items()), folder, _read_jax_settings()
    program = _programs.get(key)
    if program is None:

        def flat(*leaves):
            return function(static, *jax.tree.unflatten(structure, leaves))

        def jitted():
            flat.__name__ = function.__name__
            return jax.jit(flat, compiler_options=supported_options(options))

        placed = [(leaf.shape, str(leaf.dtype), str(getattr(leaf, "sharding", None))) for leaf in leaves]
        name = function.__module__, function.__qualname__
        made_of = (*name, static, structure, placed, sorted(options.items()))
        # The structure of the arguments may contain laws.
        foreign = has_user_objects((static, jax.tree.unflatten(structure, [None] * len(leaves))))
        program = load_or_compile(made_of, jitted, leaves, None if foreign else folder)
        _programs[key] = program
    return program, leaves


def load_or_compile(
    made_of: Any,
    made: Callable[[], Any],
    arguments: Iterable[Any],
    folder: str | os.PathLike[str] | None,
) -> Callable[..., Any]:
    """Return the jitted program from `made`, compiled for such arrays; without a folder not yet compiled.

    The `repr` of `made_of` describes completely from what the program is made.
    """
    if folder is None or jax.default_backend() != "cpu":
        return made()
    try:
        path = Path(folder) / f"{_hash_program(made_of)}{PROGRAM_SUFFIX}"
    except Exception:
        # This version of JAX lacks a part of the name.
        return made()
    program = _read_program(path)
    if program is None:
        lowered = made().lower(*arguments)
        program, key = compile_cache.compile_with_key(lowered)
        if key is not None:
            _write_program(path, program, key, find_calls(lowered.as_text()))
    return program


def find_calls(text: str) -> set[str]:
    """Return the names of all calls in a lowered program."""
    return {quoted or plain for quoted, plain in re.findall(r'custom_call @(?:"([^"]*)"|([^\s(]+))', text)}


def has_user_objects(value: Any) -> bool:
    """Return whether a value contains objects of other packages, or arrays or functions.

    Their `repr` may not describe them completely.
    """
    if value is None or isinstance(value, (str, bool, int, float)):
        return False
    if type(value) not in (tuple, list, dict) and type(value).__module__.split(".")[0] not in OWN_PACKAGES:
        return True
    if isinstance(value, (tuple, list, dict)):
        return any(
            has_user_objects(entry) for entry in (value.values() if isinstance(value, dict) else value)
        )
    if not dataclasses.is_dataclass(value):
        return True
    return any(has_user_objects(getattr(value, field.name)) for field in dataclasses.fields(value))


def _hash_program(made_of) -> str:
    """Return the hash of everything that determines a program."""
    from jax._src.lib import xla_client  # pyright: ignore[reportPrivateImportUsage]

    processor = xla_client.get_topology_for_devices(jax.devices()).fingerprint()
    settings = _read_jax_settings()
    if not settings:
        raise LookupError("settings")
    process = processor, jax.device_count(), rounding_flags(active_xla_flags()), sorted(settings)
    text = repr((made_of, process, sources_sha256(), dependency_versions()))
    return hashlib.sha256(text.encode()).hexdigest()


def _read_jax_settings() -> tuple[tuple[str, Any], ...]:
    """Return JAX's settings in this thread, except folders; empty if JAX does not provide them."""
    values = getattr(jax.config, "values", {})
    return tuple([(name, getattr(jax.config, name, values[name])) for name in values if name[-4:] != "_dir"])


def _read_program(path: Path) -> Any:
    """Return the program from a file; None if there is none or it is unreadable."""
    start = time.monotonic()
    content = read_checksummed(path)
    if content is None:
        return None
    try:
        program = _deserialise_program(content)
        jax.monitoring.record_event_duration_secs(READ_TIME_EVENT, time.monotonic() - start)
        return program
    except Exception:
        # Another version wrote the file, or the machine code was deleted.
        return None


def _write_program(path: Path, program: Any, key: str, calls: set[str]) -> None:
    """Write a program atomically; errors are ignored, since only the next call takes longer.

    Possible errors are a full or read-only folder, or a version of JAX that cannot serialise.
    """
    if not all(CACHEABLE_CALLS.fullmatch(name) for name in calls):
        return
    with suppress(Exception):
        content = _serialise_program(program, key, any(name.startswith("lapack") for name in calls))
        remove_stale(path.parent)
        write_checksummed(path, content, lasting=False)


def _serialise_program(program, key, calls_lapack):
    """Return the content of a program's file."""
    from jax.experimental import serialize_executable

    content, unloaded = io.BytesIO(), program._executable._unloaded_executable

    class Pickler(serialize_executable._JaxPjrtPickler):
        """Pickler that writes the key of the machine code instead of the code."""

        def persistent_id(self, obj):
            """Return the key instead of the machine code."""
            return (MACHINE_CODE_TAG, key) if obj is unloaded.xla_executable else super().persistent_id(obj)

    pickle.dump((calls_lapack, [device.id for device in unloaded.device_list]), content)
    Pickler(content).dump((unloaded, program.args_info, program.out_tree, program._no_kwargs))
    return content.getvalue()


def _deserialise_program(content):
    """Return the program from a file's content."""
    from jax._src import compilation_cache
    from jax._src.lax import linalg
    from jax.experimental import serialize_executable

    class Unpickler(serialize_executable._JaxPjrtUnpickler):
        """Unpickler that reads the machine code from the compile cache."""

        def persistent_load(self, pid):
            """Return the machine code with a key."""
            if pid[0] != MACHINE_CODE_TAG:
                return super().persistent_load(pid)
            client, devices = self.backend, self.execution_devices
            code, _ = compilation_cache.get_executable_and_time(pid[1], None, client, devices)
            if code is None:
                raise LookupError(pid[1])
            return code

    file = io.BytesIO(content)
    calls_lapack, indices = pickle.load(file)
    if calls_lapack:
        # Normally JAX does this when it lowers a call of LAPACK.
        linalg.initialize_lapack()
    devices = {device.id: device for device in jax.devices()}
    client, used_devices = jax.devices()[0].client, [devices[index] for index in indices]
    unloaded, arguments, result, no_kwargs = Unpickler(file, client, used_devices).load()
    return jax.stages.Compiled(unloaded.load(), [], arguments, result, no_kwargs=no_kwargs)
