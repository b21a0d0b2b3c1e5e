"""`tuning.verify`: does the runtime on the rig do what was simulated and tuned?

A bundle is checked against its manifest from here, then by its own self-test in a bare interpreter, and then
as its gain file is.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments


@dataclass(frozen=True)
class Verification:
    """What `verify` returns; `document` is all that is known, as `jaxhil verify --json` prints it."""

    document: dict[str, Any]

    @property
    def good(self) -> bool:
        """Whether the runtime agrees."""
        return self.document["verdict"]

    @property
    def reasons(self) -> list[str]:
        """Why it is bad; none if it is good."""
        return list(self.document["reasons"])


@arguments.entry
def verify(path: Any, *, scenarios: int = 6, seed: int = 0, progress: bool = False) -> Verification:
    """Replay recorded signals through the rig's runtime.

    Of a bundle, its self-test comes first; nothing of one that was tampered with is run.

    Args:
        path: of a bundle, a gain file, or the folder of one; or what `tuning.tune` returned.
        scenarios: runs to replay: the nominal one, then draws.
        seed: of the draws.
        progress: say on standard error what is going on.

    Raises:
        InputError: one line, if there is nothing to read, or the law has no runtime.
    """
    arguments.integers(1, scenarios=scenarios)
    arguments.integers(0, seed=seed)
    arguments.flags(progress=progress)
    if hasattr(path, "document"):
        return Verification(_verified(path, {}, scenarios, seed, progress))
    folder = arguments.folder("path", path)
    from tuning.bundle.manifest import is_bundle

    if not _is_folder(folder) or not is_bundle(folder):
        file = arguments.readable_gain_file(path, "path")
        return Verification(_verified(file, {"file": str(file)}, scenarios, seed, progress))
    from tuning.bundle.checking import check_bundle

    checked = check_bundle(folder)
    document: dict[str, Any] = {"bundle": str(folder), "self_test": checked.lines}
    if checked.reasons:
        document.update(verdict=False, reasons=checked.reasons)
    else:
        file = folder / "gains.json"
        document.update(_verified(file, {"file": str(file)}, scenarios, seed, progress))
    return Verification(document)


def _verified(given: Any, document: dict[str, Any], scenarios: int, seed: int, progress: bool):
    """What verification finds of a gain file."""
    with computing():
        import msgspec

        from tuning.verification.replay import verify

        try:
            loaded = arguments.gain_file(given)
        except InputError as error:
            return {**document, "verdict": False, "reasons": [str(error)]}
        arguments.runtime(loaded.compensator)
        with terminal.stages(3, progress) as stages:
            found = verify(loaded, scenarios, seed, stages.begin)
        return {**document, "mechanism": loaded.mechanism.name, **msgspec.to_builtins(found)}


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False
