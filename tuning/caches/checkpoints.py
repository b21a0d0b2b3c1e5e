"""Checkpoints ("pieces") of long work, with which an interrupted run can resume.

A piece is a value that took long to compute, in a sealed file beside the results. It contains a digest of
everything that determines it: the inputs and the code. A run that resumes uses a piece if the digest is that
of the value it is about to compute, which would be equal to the bit; otherwise it computes the value and
replaces the piece. Reading executes no code: the content is MessagePack, decoded into the requested types,
with all bits of every number.

Several machines can share pieces by these digests, since a piece does not depend on the machine that made it.
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

CHECKPOINT_FOLDER = ".pieces"  # name of the folder, beside the results of a command
CHECKPOINT_SUFFIX = ".piece"


class Checkpoints:
    """Pieces in a folder; without a folder nothing is stored, and only to `resume` are pieces read."""

    def __init__(self, folder: Path | None = None, resume: bool = False):
        self._folder, self._resume = folder, resume
        # Names of pieces that have another digest or are damaged, and errors of pieces that could not be
        # written. Neither stops the computation.
        self.other: list[str] = []
        self.unwritten: list[InputError] = []

    @property
    def is_enabled(self) -> bool:
        """Return whether there is a folder."""
        return self._folder is not None

    @property
    def is_resuming(self) -> bool:
        """Return whether existing pieces are read."""
        return self._resume and self.is_enabled

    def read(self, name: str, inputs: Any, kind: Any) -> Any:
        """Return the piece of this name, of type `kind`, if it has these inputs; else None.

        `inputs` consists of mappings, sequences, records, text and numbers. Together with the code it must
        determine the piece.
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
                pass  # The file is intact, but another version wrote another type.
        self.other.append(name)
        return None

    def write(self, name: str, inputs: Any, value: Any) -> None:
        """Write a piece; an error is added to `unwritten`."""
        path = self._path(name)
        if path is None:
            return
        content = encode_value((compute_digest(inputs), msgspec.Raw(encode_value(value))))
        with self._recording_errors(path):
            make_folder(path.parent)
            remove_stale(path.parent)
            write_checksummed(path, content)

    def journal(self, name: str, inputs: Any) -> "StepCheckpoints":
        """Return the journal of a computation with these inputs."""
        steps = Checkpoints(
            None if self._folder is None else self._folder / _build_file_name(name), self._resume
        )
        steps.other, steps.unwritten = self.other, self.unwritten
        return StepCheckpoints(steps, inputs)

    def remove(self) -> None:
        """Remove all pieces, and their folder if it is then empty; an error is added to `unwritten`."""
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
        """Return the path of a piece, or None without a folder."""
        return None if self._folder is None else self._folder / f"{_build_file_name(name)}{CHECKPOINT_SUFFIX}"

    @contextmanager
    def _recording_errors(self, path: Path) -> Iterator[None]:
        """Add an error of writing to `unwritten` instead of raising it."""
        try:
            with report_write_errors(path):
                yield
        except InputError as error:
            self.unwritten.append(error)


class StepCheckpoints:
    """Pieces of the steps of one computation, which are stored until the whole computation is finished.

    The inputs and the previous steps must determine the result of a step. Steps of equal name are numbered.
    """

    def __init__(self, pieces: Checkpoints, inputs: Any):
        self._pieces, self._inputs = pieces, inputs
        self._numbers: dict[str, int] = {}

    def step(self, name: str, kind: Any, make: Callable[[], Any]) -> Any:
        """Return the stored result of a step, of type `kind`, or call `make` and store its result."""
        number = self._numbers[name] = self._numbers.get(name, 0) + 1
        inputs = self._inputs, name, number
        result = self._pieces.read(f"{name} {number}", inputs, kind)
        if result is None:
            result = make()
            self._pieces.write(f"{name} {number}", inputs, result)
        return result

    def finish(self) -> None:
        """Remove the steps, after the whole result was stored."""
        self._pieces.remove()


NO_CHECKPOINTS = Checkpoints()


def compute_digest(inputs: Any) -> str:
    """Return the SHA-256 of inputs, code and compiler flags; the order of mappings does not matter."""
    whole = (inputs, sources_sha256(), dependency_versions(), rounding_flags(active_xla_flags()))
    return hashlib.sha256(encode_value(whole, order="deterministic")).hexdigest()


def encode_value(value: Any, order: Literal["deterministic"] | None = None) -> bytes:
    """Encode mappings, sequences, records, arrays, text and numbers as MessagePack. Raise TypeError."""
    return msgspec.msgpack.encode(value, enc_hook=_convert_to_plain, order=order)


def decode_value(content: bytes | msgspec.Raw, kind: Any) -> Any:
    """Decode a value of type `kind`. Raise `msgspec.MsgspecError` if the content has another type."""
    return msgspec.msgpack.decode(content, type=kind, dec_hook=_restore_array)


def _build_file_name(name: str) -> str:
    """Return a unique and readable file name for a piece's name."""
    readable = re.sub(r"[^A-Za-z0-9-]+", "-", name)[:80]
    return f"{readable}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _convert_to_plain(value: Any) -> Any:
    """Return NumPy numbers and arrays as plain data. Raise TypeError for anything else."""
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "__array__") and (array := np.asarray(value)).dtype.kind in "biuf":
        return array.dtype.str, array.shape, array.tobytes()
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _restore_array(kind: type, value: Any) -> Any:
    """Return the array that `_convert_to_plain` converted."""
    name, shape, content = value
    return np.frombuffer(content, np.dtype(name)).reshape(shape).copy()
