"""Programs kept between calls as the compiler made them: what runs again is neither traced nor lowered.

That takes longer than running a short batch. What jax knows of a compiled program is kept in a file whose
name is made of all it depends on: the sources, the versions of what they stand on, static arguments, shapes,
the settings of jax, the compiler's flags and options, and the processor. The machine code stays in the
compile cache and is named by its key there: jax can write code whole, but what it has read itself it writes
so that it ends in an error when it runs. As with that cache, whoever may write into the folder may run code
in the process that reads it: files are sealed against damage, not against their author.

Not all that is used of jax here is public. Where it is not there, and on graphics cards, nothing is kept.
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

from jaxhil.files import read_sealed, remove_stale, write_sealed
from jaxhil.simulation import compile_cache
from jaxhil.simulation.environment import known_options, program_folder, rounding_flags, xla_flags
from jaxhil.simulation.sources import PACKAGES, sources_sha256, versions

ENDING = ".compiled"  # of the files' names
READING = "/jax/compilation_cache/cache_retrieval_time_sec"  # jax's name for the time that takes
CODE = "exec"  # what jax calls machine code in its pickles
# What a program may call: of LAPACK, which is made ready before the program is used, and what only tells the
# compiler where arrays are. Anything else may be a function of the process that wrote it.
CALLS = re.compile(r"lapack_\w+|Sharding|SPMD\w+|xla\.sdy\.\w+")

_programs: dict[Any, Callable[..., Any]] = {}  # of this process


def run(
    function: Callable[..., Any],
    static: Any,
    *arguments: Any,
    options: Mapping[str, int | str] = MappingProxyType({}),
) -> Any:
    """`function(static, *arguments)`, compiled with the compiler's `options`.

    `function` is one of a module; its result is made of arrays, tuples and named tuples. `static` is
    hashable, and its `repr` tells all of it; `arguments` are pytrees of arrays, those of equal shapes placed
    alike. Programs are kept beside the compiled ones, but for those of what is foreign.
    """
    program, leaves = _look_up(function, static, arguments, options)
    return program(*leaves)


def prepare(function: Callable[..., Any], static: Any, *arguments: Any) -> None:
    """Make what `run` will run on such arguments."""
    program, leaves = _look_up(function, static, arguments, {})
    make(program, leaves)


def make(program: Any, arguments: Iterable[Any]) -> None:
    """Compile what `compiled` returned, if it is not."""
    if not isinstance(program, jax.stages.Compiled):
        program.lower(*arguments).compile()


def _look_up(function, static, arguments, options):
    leaves, structure = jax.tree.flatten(arguments)
    folder = program_folder()
    shapes = tuple([(leaf.shape, leaf.dtype) for leaf in leaves])
    key = function, static, structure, shapes, frozenset(options.items()), folder, _settings()
    program = _programs.get(key)
    if program is None:

        def flat(*leaves):
            return function(static, *jax.tree.unflatten(structure, leaves))

        def made():
            flat.__name__ = function.__name__
            return jax.jit(flat, compiler_options=known_options(options))

        placed = [(leaf.shape, str(leaf.dtype), str(getattr(leaf, "sharding", None))) for leaf in leaves]
        named = function.__module__, function.__qualname__
        made_of = (*named, static, structure, placed, sorted(options.items()))
        # Arguments may have laws in their structure.
        foreign = is_foreign((static, jax.tree.unflatten(structure, [None] * len(leaves))))
        program = compiled(made_of, made, leaves, None if foreign else folder)
        _programs[key] = program
    return program, leaves


def compiled(
    made_of: Any,
    made: Callable[[], Any],
    arguments: Iterable[Any],
    folder: str | os.PathLike[str] | None,
) -> Callable[..., Any]:
    """The jitted program that `made` returns, compiled for such arrays; as it is without a folder.

    The `repr` of what it is `made_of` tells all of that.
    """
    if folder is None or jax.default_backend() != "cpu":
        return made()
    try:
        path = Path(folder) / f"{_name(made_of)}{ENDING}"
    except Exception:
        # A jax that does not tell all that the name is made of.
        return made()
    program = _read(path)
    if program is None:
        lowered = made().lower(*arguments)
        program, key = compile_cache.compiled(lowered)
        if key is not None:
            _write(path, program, key, calls_of(lowered.as_text()))
    return program


def calls_of(text: str) -> set[str]:
    """The names of all that a lowered program calls."""
    return {quoted or plain for quoted, plain in re.findall(r'custom_call @(?:"([^"]*)"|([^\s(]+))', text)}


def is_foreign(value: Any) -> bool:
    """Whether anything of another package is in it, or what its text does not tell: an array, a function."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return False
    if type(value) not in (tuple, list, dict) and type(value).__module__.split(".")[0] not in PACKAGES:
        return True
    if isinstance(value, (tuple, list, dict)):
        return any(is_foreign(entry) for entry in (value.values() if isinstance(value, dict) else value))
    if not dataclasses.is_dataclass(value):
        return True
    return any(is_foreign(getattr(value, field.name)) for field in dataclasses.fields(value))


def _name(made_of) -> str:
    from jax._src.lib import xla_client  # pyright: ignore[reportPrivateImportUsage]

    processor = xla_client.get_topology_for_devices(jax.devices()).fingerprint()
    settings = _settings()
    if not settings:
        raise LookupError("settings")
    here = processor, jax.device_count(), rounding_flags(xla_flags()), sorted(settings)
    text = repr((made_of, here, sources_sha256(), versions()))
    return hashlib.sha256(text.encode()).hexdigest()


def _settings() -> tuple[tuple[str, Any], ...]:
    """What jax is set to in this thread now, but for folders; nothing where it does not tell."""
    known = getattr(jax.config, "values", {})
    return tuple([(name, getattr(jax.config, name, known[name])) for name in known if name[-4:] != "_dir"])


def _read(path: Path) -> Any:
    """The program kept in a file; None if there is none, or none that can be read."""
    begun = time.monotonic()
    content = read_sealed(path)
    if content is None:
        return None
    try:
        program = _from_bytes(content)
        jax.monitoring.record_event_duration_secs(READING, time.monotonic() - begun)
        return program
    except Exception:
        # Written whole, but by something else; or the machine code is gone.
        return None


def _write(path: Path, program: Any, key: str, calls: set[str]) -> None:
    """All or nothing; a folder that has become full or read-only, and a jax that cannot do it, cost only the
    next call's time."""
    if not all(CALLS.fullmatch(name) for name in calls):
        return
    with suppress(Exception):
        content = _to_bytes(program, key, any(name.startswith("lapack") for name in calls))
        remove_stale(path.parent)
        write_sealed(path, content, lasting=False)


def _to_bytes(program, key, calls_lapack):
    from jax.experimental import serialize_executable

    content, unloaded = io.BytesIO(), program._executable._unloaded_executable

    class Pickler(serialize_executable._JaxPjrtPickler):
        def persistent_id(self, obj):
            return (CODE, key) if obj is unloaded.xla_executable else super().persistent_id(obj)

    pickle.dump((calls_lapack, [device.id for device in unloaded.device_list]), content)
    Pickler(content).dump((unloaded, program.args_info, program.out_tree, program._no_kwargs))
    return content.getvalue()


def _from_bytes(content):
    from jax._src import compilation_cache
    from jax._src.lax import linalg
    from jax.experimental import serialize_executable

    class Unpickler(serialize_executable._JaxPjrtUnpickler):
        def persistent_load(self, pid):
            if pid[0] != CODE:
                return super().persistent_load(pid)
            client, devices = self.backend, self.execution_devices
            code, _ = compilation_cache.get_executable_and_time(pid[1], None, client, devices)
            if code is None:
                raise LookupError(pid[1])
            return code

    file = io.BytesIO(content)
    calls_lapack, places = pickle.load(file)
    if calls_lapack:
        # As a rule that happens when a call of it is lowered.
        linalg.initialize_lapack()
    devices = {device.id: device for device in jax.devices()}
    client, own = jax.devices()[0].client, [devices[place] for place in places]
    unloaded, arguments, result, no_kwargs = Unpickler(file, client, own).load()
    return jax.stages.Compiled(unloaded.load(), [], arguments, result, no_kwargs=no_kwargs)
