"""Checkpoints of long computations, from which an interrupted run can resume.

A checkpoint is a file next to the results of a command. It stores the result of one work unit (part of the
computation), a digest of the inputs and the code that determine this result, and a checksum. A resumed run
uses the checkpoint if its own inputs and code have the same digest: it would compute the same result to the
last bit. Otherwise it computes the result and replaces the checkpoint.

The format is MessagePack, so that reading a file executes no code and numbers keep all their bits.
Checkpoints do not depend on the machine that wrote them, so that several machines can share them.
"""

import hashlib
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from jaxhil.errors import InputError
from jaxhil.files import make_folder, read_checksummed, remove_stale, report_write_errors, write_checksummed
from jaxhil.simulation.jax_environment import active_xla_flags, rounding_flags
from jaxhil.simulation.source_fingerprint import dependency_versions, sources_sha256

CHECKPOINT_FOLDER = ".pieces"  # name of the checkpoint folder, next to the results of a command
CHECKPOINT_SUFFIX = ".piece"


class Checkpoints:
    """Folder of checkpoints, which are read if `resume` is true; without a folder, nothing is stored."""

    def __init__(self, folder: Path | None = None, resume: bool = False):
        self._folder, self._resume = folder, resume
        # names of checkpoints that are damaged or have another digest, and errors of checkpoints that could
        # not be written; neither stops the computation
        self.other: list[str] = []
        self.unwritten: list[InputError] = []

    @property
    def is_enabled(self) -> bool:
        """Return whether there is a folder in which checkpoints are stored."""
        return self._folder is not None

    @property
    def is_resuming(self) -> bool:
        """Return whether existing checkpoints are read."""
        return self._resume and self.is_enabled

    def read(self, name: str, inputs: Any, kind: Any) -> Any:
        """Read the result of the checkpoint `name`, of type `kind`.

        Return None if the checkpoint is missing or damaged, or if `inputs` or the code differ from those of
        the stored result. `inputs` and the code must determine the result. `inputs` are mappings, sequences,
        records, arrays, text and numbers.
        """
        path = self._path(name)
        if path is None or not self._resume or not path.exists():
            return None
        content = read_checksummed(path)
        if content is not None:
            try:
                digest, value = msgspec.msgpack.decode(content, type=tuple[str, msgspec.Raw])
                if digest == compute_digest(inputs):
                    return decode_value(value, kind)
            except (msgspec.MsgspecError, ValueError, TypeError):
                pass  # The file is intact, but another version of the program wrote a result of another type.
        self.other.append(name)
        return None

    def write(self, name: str, inputs: Any, value: Any) -> None:
        """Write a result as the checkpoint `name`; if writing fails, add the error to `unwritten`."""
        path = self._path(name)
        if path is None:
            return
        content = encode_value((compute_digest(inputs), msgspec.Raw(encode_value(value))))
        with self._recording_errors(path):
            make_folder(path.parent)
            remove_stale(path.parent)
            write_checksummed(path, content)

    def journal(self, name: str, inputs: Any) -> "StepCheckpoints":
        """Return the checkpoints for the steps of the computation `name`; `inputs` determine its result."""
        steps = Checkpoints(
            None if self._folder is None else self._folder / _build_file_name(name), self._resume
        )
        steps.other, steps.unwritten = self.other, self.unwritten
        return StepCheckpoints(steps, inputs)

    def remove(self) -> None:
        """Remove all checkpoints, and then their folder if it is empty; add any error to `unwritten`."""
        if self._folder is None or not self._folder.is_dir():
            return
        with self._recording_errors(self._folder):
            remove_stale(self._folder)
            for path in self._folder.glob(f"*{CHECKPOINT_SUFFIX}"):
                if path.is_file() and not path.is_symlink():
                    path.unlink(missing_ok=True)
            if not any(self._folder.iterdir()):
                self._folder.rmdir()

    def _path(self, name: str) -> Path | None:
        return None if self._folder is None else self._folder / f"{_build_file_name(name)}{CHECKPOINT_SUFFIX}"

    @contextmanager
    def _recording_errors(self, path: Path) -> Iterator[None]:
        """Context manager: add a write error of the `with` block to `unwritten` instead of raising it."""
        try:
            with report_write_errors(path):
                yield
        except InputError as error:
            self.unwritten.append(error)


class StepCheckpoints:
    """Checkpoints of a computation's steps; they are kept until the whole computation is finished.

    The result of a step must depend only on the inputs and the previous steps. Steps with the same name are
    numbered.
    """

    def __init__(self, pieces: Checkpoints, inputs: Any):
        self._checkpoints, self._inputs = pieces, inputs
        self._numbers: dict[str, int] = {}

    def step(self, name: str, kind: Any, make: Callable[[], Any]) -> Any:
        """Return the stored result of step `name`, of type `kind`; else call `make` and store its result."""
        number = self._numbers[name] = self._numbers.get(name, 0) + 1
        inputs = self._inputs, name, number
        result = self._checkpoints.read(f"{name} {number}", inputs, kind)
        if result is None:
            result = make()
            self._checkpoints.write(f"{name} {number}", inputs, result)
        return result

    def finish(self) -> None:
        """Remove the checkpoints of all steps, after the result of the computation was stored."""
        self._checkpoints.remove()


NO_CHECKPOINTS = Checkpoints()


def compute_digest(inputs: Any) -> str:
    """Return the SHA-256 digest of inputs, code and compiler flags; the order of keys has no effect."""
    whole = (inputs, sources_sha256(), dependency_versions(), rounding_flags(active_xla_flags()))
    return hashlib.sha256(encode_value(whole, order="deterministic")).hexdigest()


def encode_value(value: Any, order: Literal["deterministic"] | None = None) -> bytes:
    """Encode mappings, sequences, records, arrays, text and numbers as MessagePack, or raise TypeError."""
    return msgspec.msgpack.encode(value, enc_hook=_convert_to_plain, order=order)


def decode_value(content: bytes | msgspec.Raw, kind: Any) -> Any:
    """Decode a MessagePack value of type `kind`; raise `msgspec.MsgspecError` if it has another type."""
    return msgspec.msgpack.decode(content, type=kind, dec_hook=_restore_array)


def _build_file_name(name: str) -> str:
    readable = re.sub(r"[^A-Za-z0-9-]+", "-", name)[:80]
    return f"{readable}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _convert_to_plain(value: Any) -> Any:
    """Convert a NumPy number or array to plain data; raise TypeError for a value of another type."""
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "__array__") and (array := np.asarray(value)).dtype.kind in "biuf":
        return array.dtype.str, array.shape, array.tobytes()
    raise TypeError(f"checkpoint: found a {type(value).__name__}, expected plain data or an array")


def _restore_array(kind: type, value: Any) -> Any:
    name, shape, content = value
    return np.frombuffer(content, np.dtype(name)).reshape(shape).copy()
