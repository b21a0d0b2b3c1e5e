"""Disk cache of compiled programs, so that later processes need not trace and lower them again.

Tracing and lowering can take longer than the simulation itself. For each compiled program, a file contains
the data that JAX needs to load this program. The file's name is the hash of everything that determines the
program: sources, versions of dependencies, static arguments, array shapes, settings of JAX, compiler flags
and options, and processor.

The machine code is not in this file but in the compile cache (`jaxhil.simulation.compile_cache`); the file
contains only the key of the machine code. JAX could also serialise the machine code, but machine code that
JAX has loaded from a file cannot be serialised again.

Anyone who can write to the cache folder can run code in the processes that read the cache. The checksums
protect against damaged files, not against malicious files.

This module uses private functions of JAX. If one of them is missing, nothing is cached. Programs for graphics
cards are never cached.
"""

import dataclasses
import hashlib
import io
import os
import pickle
import re
import threading
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

PROGRAM_SUFFIX = ".compiled"  # suffix of the names of the cached files
# Name of the JAX event that records the time for reading a program.
READ_TIME_EVENT = "/jax/compilation_cache/cache_retrieval_time_sec"
MACHINE_CODE_TAG = "exec"  # tag with which JAX marks machine code in its pickles
# Custom calls that a cached program may contain: LAPACK, which is initialised before the program is used, and
# annotations that say on which device an array is. Any other call may need a function of the process that
# wrote the program.
CACHEABLE_CALLS = re.compile(r"lapack_\w+|Sharding|SPMD\w+|xla\.sdy\.\w+")

Options = Mapping[str, int | str]  # compiler options by name
NO_OPTIONS: Options = MappingProxyType({})

_programs: dict[Any, Any] = {}  # compiled programs that this process has used
# Threads lower one program at a time. Lowering is Python code, so that two at once would delay each other.
_lowering = threading.RLock()


def run_cached(
    function: Callable[..., Any], static: Any, *arguments: Any, options: Options = NO_OPTIONS
) -> Any:
    """Return `function(static, *arguments)`, computed by a compiled program from the cache.

    A program that is not in the cache is compiled and written there, unless it contains user-registered laws.

    Args:
        function: Function defined at the top of a module. Its result consists of arrays, tuples and named
            tuples.
        static: Hashable argument whose `repr` describes it completely.
        *arguments: Pytrees of arrays. Arrays of equal shape must be placed on the same devices.
        options: Options of XLA's compiler.
    """
    program, leaves = _find_program(function, static, arguments, options)
    return program(*leaves)


def lower_cached(
    function: Callable[..., Any], static: Any, *arguments: Any, options: Options = NO_OPTIONS
) -> Callable[[], None]:
    """Lower the program that `run_cached` will use for these arguments; return a function that compiles it.

    Lowering holds Python's lock, compiling does not: another thread can compile while this one continues.
    """
    key, leaves, prepare = _identify_program(function, static, arguments, options)
    program = _programs.get(key)
    finish = prepare() if program is None else lambda: program

    def compile_program() -> None:
        _programs[key] = compiled = finish()
        if not isinstance(compiled, jax.stages.Compiled):
            compiled.lower(*leaves).compile()

    return compile_program


def _find_program(function, static, arguments, options):
    """Return the compiled program for these arguments, and the arrays to pass to this program."""
    key, leaves, prepare = _identify_program(function, static, arguments, options)
    program = _programs.get(key)
    if program is None:
        _programs[key] = program = prepare()()
    return program, leaves


def _identify_program(function, static, arguments, options):
    """Return a program's key and array arguments, and a function that calls `load_or_lower` for it."""
    leaves, structure = jax.tree.flatten(arguments)
    folder = program_folder()
    shapes = tuple([(leaf.shape, leaf.dtype) for leaf in leaves])
    key = function, static, structure, shapes, frozenset(options.items()), folder, _read_jax_settings()

    def flat(*leaves):
        return function(static, *jax.tree.unflatten(structure, leaves))

    def jitted():
        flat.__name__ = function.__name__
        return jax.jit(flat, compiler_options=supported_options(options))

    def prepare():
        placed = [(leaf.shape, str(leaf.dtype), str(getattr(leaf, "sharding", None))) for leaf in leaves]
        name = function.__module__, function.__qualname__
        identity = (*name, static, structure, placed, sorted(options.items()))
        # The static argument and the tree structure of the array arguments may contain user-registered laws.
        is_uncacheable = has_user_objects((static, jax.tree.unflatten(structure, [None] * len(leaves))))
        return load_or_lower(identity, jitted, leaves, None if is_uncacheable else folder)

    return key, leaves, prepare


def load_or_lower(
    identity: Any,
    build: Callable[[], Any],
    arguments: Iterable[Any],
    folder: str | os.PathLike[str] | None,
) -> Callable[[], Callable[..., Any]]:
    """Load a compiled program from the cache folder, or lower it.

    Return a function without arguments that returns the program. If the program was lowered, this function
    compiles and stores it. Without a folder, or on a graphics card, the program is the jitted one, which JAX
    compiles at its first call.

    Args:
        identity: Object whose `repr` describes completely how the program is built.
        build: Function that returns the jitted program.
        arguments: Arrays, or their shapes, for which the program is compiled.
        folder: Folder of cached programs; None to cache nothing.
    """
    if folder is None or jax.default_backend() != "cpu":
        return build
    try:
        path = Path(folder) / f"{_hash_program(identity)}{PROGRAM_SUFFIX}"
    except Exception:
        # This version of JAX does not provide all data for the hash, so that nothing can be cached.
        return build
    program = _read_program(path)
    if program is not None:
        return lambda: program
    with _lowering:
        lowered = build().lower(*arguments)

    def compile_program():
        program, key = compile_cache.compile_with_key(lowered)
        if key is not None:
            _write_program(path, program, key, find_calls(lowered.as_text()))
        return program

    return compile_program


def find_calls(text: str) -> set[str]:
    """Return the names of the custom calls (to functions outside XLA) in a lowered program."""
    return {quoted or plain for quoted, plain in re.findall(r'custom_call @(?:"([^"]*)"|([^\s(]+))', text)}


def has_user_objects(value: Any) -> bool:
    """Return whether a value contains objects whose `repr` may be an incomplete description.

    Such objects are arrays, functions, and objects whose class is defined outside this project.
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


def _hash_program(identity) -> str:
    """Return a SHA-256 hash of everything that determines a compiled program."""
    from jax._src.lib import xla_client  # pyright: ignore[reportPrivateImportUsage]

    processor = xla_client.get_topology_for_devices(jax.devices()).fingerprint()
    settings = _read_jax_settings()
    if not settings:
        raise LookupError("settings of JAX: found none")
    process = processor, jax.device_count(), rounding_flags(active_xla_flags()), sorted(settings)
    text = repr((identity, process, sources_sha256(), dependency_versions()))
    return hashlib.sha256(text.encode()).hexdigest()


def _read_jax_settings() -> tuple[tuple[str, Any], ...]:
    """Return names and values of JAX's settings in this thread, except folders; none if JAX hides them."""
    values = getattr(jax.config, "values", {})
    return tuple([(name, getattr(jax.config, name, values[name])) for name in values if name[-4:] != "_dir"])


def _read_program(path: Path) -> Any:
    """Return the compiled program in a file; None if the file is missing or cannot be used."""
    start = time.monotonic()
    content = read_checksummed(path)
    if content is None:
        return None
    try:
        program = _deserialise_program(content)
        jax.monitoring.record_event_duration_secs(READ_TIME_EVENT, time.monotonic() - start)
        return program
    except Exception:
        # A different version of JAX wrote the file, or the compile cache no longer has the machine code.
        return None


def _write_program(path: Path, program: Any, key: str, calls: set[str]) -> None:
    """Write a compiled program to a file if all its custom calls can be cached.

    Errors are ignored, because an uncached program only costs time. Typical errors are a full disk, a
    read-only folder, or a version of JAX that cannot serialise the program.
    """
    if not all(CACHEABLE_CALLS.fullmatch(name) for name in calls):
        return
    with suppress(Exception):
        content = _serialise_program(program, key, any(name.startswith("lapack") for name in calls))
        remove_stale(path.parent)
        write_checksummed(path, content, lasting=False)


def _serialise_program(program, key, calls_lapack):
    """Return a compiled program as bytes; `key` is the key of its machine code in the compile cache."""
    from jax.experimental import serialize_executable

    content, unloaded = io.BytesIO(), program._executable._unloaded_executable

    class Pickler(serialize_executable._JaxPjrtPickler):
        """Pickler that writes the machine code's key in the compile cache instead of the machine code."""

        def persistent_id(self, obj):
            """Return the cache key if `obj` is the machine code, else the result of JAX's pickler."""
            return (MACHINE_CODE_TAG, key) if obj is unloaded.xla_executable else super().persistent_id(obj)

    pickle.dump((calls_lapack, [device.id for device in unloaded.device_list]), content)
    Pickler(content).dump((unloaded, program.args_info, program.out_tree, program._no_kwargs))
    return content.getvalue()


def _deserialise_program(content):
    """Return the compiled program from the bytes that `_serialise_program` returned."""
    from jax._src import compilation_cache
    from jax._src.lax import linalg
    from jax.experimental import serialize_executable

    class Unpickler(serialize_executable._JaxPjrtUnpickler):
        """Unpickler that reads the machine code from the compile cache."""

        def persistent_load(self, pid):
            """Return the cached machine code if `pid` is its key, else the result of JAX's unpickler."""
            if pid[0] != MACHINE_CODE_TAG:
                return super().persistent_load(pid)
            client, devices = self.backend, self.execution_devices
            code, _ = compilation_cache.get_executable_and_time(pid[1], None, client, devices)
            if code is None:
                raise LookupError(f"machine code: found none with key {pid[1]}")
            return code

    file = io.BytesIO(content)
    calls_lapack, indices = pickle.load(file)
    if calls_lapack:
        # JAX initialises LAPACK when it lowers a LAPACK call. This process may not have lowered any.
        linalg.initialize_lapack()
    devices = {device.id: device for device in jax.devices()}
    client, used_devices = jax.devices()[0].client, [devices[index] for index in indices]
    unloaded, arguments, result, no_kwargs = Unpickler(file, client, used_devices).load()
    return jax.stages.Compiled(unloaded.load(), [], arguments, result, no_kwargs=no_kwargs)
