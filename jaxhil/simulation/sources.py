"""What results follow from besides the input: the sources of these packages, and what they stand on."""

import hashlib
import inspect
import platform
import sys
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path

PACKAGES = ("jaxhil", "tuning")
STANDS_ON = ("jax", "jaxlib", "optimistix", "equinox", "lineax", "numpy", "scipy")


def sources_sha256(*laws: object) -> str:
    """SHA-256 of the names and contents of the Python files of the packages that are imported, as they were
    when first asked for.

    With `laws`, compensators and contact laws, also of those among them that are from elsewhere: their fields
    and the module that they are in, as far as it has a source.
    """
    own = _digest(
        tuple(Path(str(sys.modules[name].__file__)).parent for name in PACKAGES if name in sys.modules)
    )
    foreign = [law for law in laws if type(law).__module__.partition(".")[0] not in PACKAGES]
    if not foreign:
        return own
    told = [(type(law).__qualname__, repr(law), _source(type(law))) for law in foreign]
    return hashlib.sha256(repr((own, told)).encode()).hexdigest()


@cache
def versions(packages: tuple[str, ...] = ("jaxhil", *STANDS_ON)) -> dict[str, str]:
    """Versions of Python and of packages, by default of all that the numbers depend on."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _source(kind: type) -> str:
    for one in (sys.modules.get(kind.__module__), kind):
        with suppress(OSError, TypeError):
            return inspect.getsource(one)  # pyright: ignore[reportArgumentType]
    return ""


@cache
def _digest(roots: tuple[Path, ...]) -> str:
    whole = hashlib.sha256()
    for root in roots:
        for source in sorted(root.rglob("*.py")):
            name = f"{root.name}/{source.relative_to(root).as_posix()}"
            content = hashlib.sha256(source.read_bytes()).hexdigest()
            whole.update(f"{content} {name}\n".encode())
    return whole.hexdigest()
