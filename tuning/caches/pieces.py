"""Finished pieces of long work, each kept at once, so that a run that was interrupted can go on.

A piece is a value that took long to compute, in a sealed file of its own beside the results. With it stands
a digest of all that it follows from: what was asked for, and the code that computed it. A run that resumes
takes a piece whose digest is that of what it is about to compute, which would be the same to the bit; it
computes any other anew, and writes it in the old one's place. Reading runs no code: the content is
MessagePack, decoded into the types that are asked for, with every bit of every number.

Whoever computes pieces on several machines can do it by the same digests: a piece does not say who made it.
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
from jaxhil.files import make_folder, read_sealed, remove_stale, write_sealed, writing
from jaxhil.simulation.environment import rounding_flags, xla_flags
from jaxhil.simulation.sources import sources_sha256, versions

FOLDER = ".pieces"  # beside the results of a command
SUFFIX = ".piece"


class Pieces:
    """The pieces in a folder; without one nothing is kept. Only to `resume` are those that are there read."""

    def __init__(self, folder: Path | None = None, resume: bool = False):
        self._folder, self._resume = folder, resume
        # Those met that follow from something else or are damaged, and why some could not be written: neither
        # stops a computation that needs them no more.
        self.other: list[str] = []
        self.unwritten: list[InputError] = []

    @property
    def keeps(self) -> bool:
        """Whether there is a folder."""
        return self._folder is not None

    @property
    def resumes(self) -> bool:
        """Whether pieces that are there are read."""
        return self._resume and self.keeps

    def read(self, name: str, inputs: Any, kind: Any) -> Any:
        """The piece of this name, a `kind`, if it follows from these inputs; else None.

        `inputs` is anything made of mappings, sequences, records, text and numbers, and tells all that the
        piece follows from but for the code.
        """
        path = self._path(name)
        if path is None or not self._resume or not path.exists():
            return None
        content = read_sealed(path)
        if content is not None:
            try:
                digest, value = msgspec.msgpack.decode(content, type=tuple[str, msgspec.Raw])
                if digest == digest_of(inputs):
                    return decode(value, kind)
            except (msgspec.MsgspecError, ValueError, TypeError):
                pass  # sealed, but by a version that wrote something else
        self.other.append(name)
        return None

    def write(self, name: str, inputs: Any, value: Any) -> None:
        """Keep a piece, as far as it can be written."""
        path = self._path(name)
        if path is None:
            return
        content = encode((digest_of(inputs), msgspec.Raw(encode(value))))
        with self._as_far_as_it_goes(path):
            make_folder(path.parent)
            remove_stale(path.parent)
            write_sealed(path, content)

    def journal(self, name: str, inputs: Any) -> "Journal":
        """The steps of one piece of work, which follows from these inputs."""
        steps = Pieces(None if self._folder is None else self._folder / _file_name(name), self._resume)
        steps.other, steps.unwritten = self.other, self.unwritten
        return Journal(steps, inputs)

    def remove(self) -> None:
        """Remove all of them, and the folder that was made for them, as far as it goes."""
        if self._folder is None or not self._folder.is_dir():
            return
        with self._as_far_as_it_goes(self._folder):
            remove_stale(self._folder)
            for path in self._folder.glob(f"*{SUFFIX}"):
                if path.is_file() and not path.is_symlink():
                    path.unlink(missing_ok=True)
            if not any(self._folder.iterdir()):
                self._folder.rmdir()

    def _path(self, name: str) -> Path | None:
        return None if self._folder is None else self._folder / f"{_file_name(name)}{SUFFIX}"

    @contextmanager
    def _as_far_as_it_goes(self, path: Path) -> Iterator[None]:
        try:
            with writing(path):
                yield
        except InputError as error:
            self.unwritten.append(error)


class Journal:
    """The steps of one piece of work, each kept until the whole is.

    What a step gives follows from the inputs and from the steps before it alone. Steps of one name are
    counted.
    """

    def __init__(self, pieces: Pieces, inputs: Any):
        self._pieces, self._inputs = pieces, inputs
        self._numbers: dict[str, int] = {}

    def step(self, name: str, kind: Any, make: Callable[[], Any]) -> Any:
        """What `make` gives, a `kind`: kept from before, or made now."""
        number = self._numbers[name] = self._numbers.get(name, 0) + 1
        inputs = self._inputs, name, number
        found = self._pieces.read(f"{name} {number}", inputs, kind)
        if found is None:
            found = make()
            self._pieces.write(f"{name} {number}", inputs, found)
        return found

    def finish(self) -> None:
        """The whole is kept: its steps are of no more use."""
        self._pieces.remove()


NOTHING_KEPT = Pieces()


def digest_of(inputs: Any) -> str:
    """SHA-256 of the inputs, whatever their order in mappings, of the code, and of how it is compiled."""
    whole = (inputs, sources_sha256(), versions(), rounding_flags(xla_flags()))
    return hashlib.sha256(encode(whole, order="deterministic")).hexdigest()


def encode(value: Any, order: Literal["deterministic"] | None = None) -> bytes:
    """Mappings, sequences, records, arrays, text and numbers as MessagePack. TypeError for anything else."""
    return msgspec.msgpack.encode(value, enc_hook=_plain, order=order)


def decode(content: bytes | msgspec.Raw, kind: Any) -> Any:
    """The value of that `kind` which `encode` got. Raises `msgspec.MsgspecError` for anything else."""
    return msgspec.msgpack.decode(content, type=kind, dec_hook=_array)


def _file_name(name: str) -> str:
    """One for each name, and readable."""
    readable = re.sub(r"[^A-Za-z0-9-]+", "-", name)[:80]
    return f"{readable}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "__array__") and (array := np.asarray(value)).dtype.kind in "biuf":
        return array.dtype.str, array.shape, array.tobytes()
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _array(kind: type, value: Any) -> Any:
    name, shape, content = value
    return np.frombuffer(content, np.dtype(name)).reshape(shape).copy()
