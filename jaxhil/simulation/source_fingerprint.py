"""Fingerprint of source code and versions of dependencies, on which results depend besides the input."""

import hashlib
import inspect
import platform
import sys
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path

OWN_PACKAGES = ("jaxhil", "tuning")
DEPENDENCIES = ("jax", "jaxlib", "optimistix", "equinox", "lineax", "numpy", "scipy")


def sources_sha256(*laws: object) -> str:
    """Return a SHA-256 hash of the Python files of this project's imported packages.

    The files are read only once per process.

    Args:
        *laws: Compensators and contact laws. The hash includes the fields of each user-registered law and,
            if available, its source code.
    """
    digest = _hash_folders(
        tuple(Path(str(sys.modules[name].__file__)).parent for name in OWN_PACKAGES if name in sys.modules)
    )
    user_laws = [law for law in laws if type(law).__module__.partition(".")[0] not in OWN_PACKAGES]
    if not user_laws:
        return digest
    descriptions = [(type(law).__qualname__, repr(law), _read_class_source(type(law))) for law in user_laws]
    return hashlib.sha256(repr((digest, descriptions)).encode()).hexdigest()


@cache
def dependency_versions(packages: tuple[str, ...] = ("jaxhil", *DEPENDENCIES)) -> dict[str, str]:
    """Return the versions of Python and of packages; by default, of all packages that affect results."""
    result = {"python": platform.python_version()}
    for name in packages:
        try:
            result[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            result[name] = "not installed"
    return result


def _read_class_source(kind: type) -> str:
    """Return the source code of a class's module, else of the class, else an empty text."""
    for source in (sys.modules.get(kind.__module__), kind):
        with suppress(OSError, TypeError):
            return inspect.getsource(source)  # pyright: ignore[reportArgumentType]
    return ""


@cache
def _hash_folders(roots: tuple[Path, ...]) -> str:
    """Return a SHA-256 hash of names and contents of all Python files in these folders."""
    digest = hashlib.sha256()
    for root in roots:
        for source in sorted(root.rglob("*.py")):
            name = f"{root.name}/{source.relative_to(root).as_posix()}"
            content = hashlib.sha256(source.read_bytes()).hexdigest()
            digest.update(f"{content} {name}\n".encode())
    return digest.hexdigest()
