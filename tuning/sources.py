"""What results follow from besides the input: the sources of these packages, and what they stand on."""

import hashlib
import platform
import sys
from functools import cache
from importlib import metadata
from pathlib import Path

PACKAGES = ("jaxhil", "tuning")
STANDS_ON = ("jax", "jaxlib", "optimistix", "equinox", "lineax", "numpy", "scipy")


def sources_sha256() -> str:
    """SHA-256 of the names and contents of the packages' Python files, as they were when first asked for."""
    return _digest(tuple(Path(str(sys.modules[name].__file__)).parent for name in PACKAGES))


@cache
def versions() -> dict[str, str]:
    """Versions of Python, of `jaxhil` and of the packages that the numbers depend on."""
    found = {"python": platform.python_version()}
    for name in ("jaxhil", *STANDS_ON):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


@cache
def _digest(roots: tuple[Path, ...]) -> str:
    whole = hashlib.sha256()
    for root in roots:
        for source in sorted(root.rglob("*.py")):
            name = f"{root.name}/{source.relative_to(root).as_posix()}"
            content = hashlib.sha256(source.read_bytes()).hexdigest()
            whole.update(f"{content} {name}\n".encode())
    return whole.hexdigest()
