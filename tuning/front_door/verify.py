"""`tuning.verify`: does the runtime on the rig do what was simulated and tuned?

A bundle is checked from here, file by file, then by its own self-test in a bare interpreter, and then as its
gain file is.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from jaxhil.errors import InputError, shown
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments
from tuning.front_door.arguments import ArgumentError
from tuning.front_door.options import Allowed, Seed, check_options, number, takes, text


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


@dataclass(frozen=True, kw_only=True)
class VerifyOptions:
    """Options of `verify`."""

    key: Annotated[
        str | None,
        text("KEY", "The bundle must be signed by this public key (Ed25519, PEM); needs jaxhil[sign]."),
    ] = None
    scenarios: Annotated[int, number("Runs to replay: the nominal one, then draws."), Allowed(1)] = 6
    seed: Annotated[int, number("Seed of the draws."), Seed] = 0


@arguments.entry
@takes(VerifyOptions)
def verify(path: Any, *, progress: bool = False, **options: Any) -> Verification:
    """Replay recorded signals through the rig's runtime.

    Of a bundle, its self-test comes first; nothing is run of one that is not, byte for byte, what this
    version exports for its gains.

    Args:
        path: of a bundle, a gain file, or the folder of one; or what `tuning.tune` returned.
        progress: say on standard error what is going on.
    OPTIONS

    Raises:
        InputError: one line, if there is nothing to read, or the law has no runtime.
    """
    asked = VerifyOptions(**options)
    check_options(asked)
    arguments.flags(progress=progress)
    key, scenarios, seed = asked.key, asked.scenarios, asked.seed
    from tuning.bundle.manifest import is_bundle

    given = hasattr(path, "document")
    folder = None if given else arguments.folder("path", path)
    if folder is not None and _is_folder(folder) and is_bundle(folder):
        return Verification(_verified_bundle(folder, key, scenarios, seed, progress))
    file = path if given else arguments.readable_gain_file(path, "path")
    if key is not None:
        raise ArgumentError("key", shown(str(key)), "only with a bundle: gain files are not signed")
    named = {} if given else {"file": str(file)}
    return Verification(_verified(file, named, scenarios, seed, progress))


def _verified_bundle(folder: Path, key: Any, scenarios: int, seed: int, progress: bool) -> dict[str, Any]:
    """What verification finds of a bundle."""
    from tuning.bundle.checking import check_bundle, run_selftest
    from tuning.bundle.signing import verifier

    signed_by = None if key is None else verifier(arguments.folder("key", key))
    with computing(), terminal.stages(2, progress) as stages:
        stages.begin("making the bundle anew from its gains")
        checked = check_bundle(folder, signed_by)
        document = {"bundle": str(folder), "signature": checked.signature, "self_test": []}
        reasons = checked.reasons
        if not reasons:
            stages.begin("running its self-test")
            document["self_test"], reasons = run_selftest(checked, os.path.basename(os.path.abspath(folder)))
    if reasons:
        return {**document, "verdict": False, "reasons": reasons}
    return _verified(checked, {**document, "file": str(folder / "gains.json")}, scenarios, seed, progress)


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
