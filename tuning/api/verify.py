"""Function `tuning.verify`, which checks that the rig's controller code reproduces the simulated controller.

For a bundle, three checks are made: all files are compared with a new export, the bundle's self-test runs in
an isolated interpreter, and the gain file is verified. If the bundle has FMUs of controller and rig, the loop
is also closed through them.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from jaxhil.errors import InputError, format_value
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments
from tuning.api.arguments import ArgumentError
from tuning.api.options import (
    AllowedValues,
    SeedRange,
    add_options,
    check_options,
    number_option,
    text_option,
)


@dataclass(frozen=True)
class Verification:
    """Result of `verify`.

    Attributes:
        document: all results, as `jaxhil verify --json` prints them.
    """

    document: dict[str, Any]

    @property
    def good(self) -> bool:
        """Return whether the runtime's commands agree with the simulated ones, and all files are intact."""
        return self.document["verdict"] == "good"

    @property
    def reasons(self) -> list[str]:
        """Return the reasons for a bad verdict; an empty list for a good one."""
        return list(self.document["reasons"])


@dataclass(frozen=True, kw_only=True)
class VerifyOptions:
    """Options of `verify`."""

    key: Annotated[
        str | None,
        text_option(
            "KEY", "Require a signature that this public key confirms (Ed25519, PEM); needs jaxhil[sign]."
        ),
    ] = None
    scenarios: Annotated[
        int,
        number_option("Number of runs to replay: the nominal run, then drawn scenarios."),
        AllowedValues(1),
    ] = 6
    seed: Annotated[int, number_option("Seed of the drawn scenarios."), SeedRange] = 0


@arguments.convert_os_errors
@add_options(VerifyOptions)
def verify(path: Any, *, progress: bool = False, **options: Any) -> Verification:
    """Check that the rig's controller code (runtime) returns the same force commands as the simulation.

    The runtime gets the sensor signals of simulated runs. The self-test of a bundle runs first. Code of a
    bundle runs only if this version of jaxhil exports the same bundle, byte for byte, from its gains.

    Args:
        path: path of a bundle, of a gain file, or of the folder of a gain file; or a result of `tuning.tune`.
        progress: report the progress on standard error.
        **options: see `VerifyOptions`.

    Returns:
        The verdict with its reasons, and all results.

    Raises:
        InputError: If the path cannot be read, or the compensator has no runtime; the message has one line.

    Example:
        >>> import tuning
        >>> tuned = tuning.tune("rig-300kg", "phase_lead", scenarios=4, starts=1, validation=4)
        >>> tuning.verify(tuned, scenarios=2).good
        True
    """
    settings = VerifyOptions(**options)
    check_options(settings)
    arguments.check_booleans(progress=progress)
    key, scenarios, seed = settings.key, settings.scenarios, settings.seed
    from tuning.bundle.manifest import is_bundle

    is_result = hasattr(path, "document")
    folder = None if is_result else arguments.check_path("path", path)
    if folder is not None and _is_folder(folder) and is_bundle(folder):
        return Verification(_verify_bundle(folder, key, scenarios, seed, progress))
    file = path if is_result else arguments.find_gain_file(path, "path")
    if key is not None:
        raise ArgumentError("key", format_value(str(key)), "no key for a gain file: only bundles are signed")
    label = {} if is_result else {"file": str(file)}
    return Verification(_verify_gains(file, label, scenarios, seed, progress)[0])


def _verify_bundle(folder: Path, key: Any, scenarios: int, seed: int, progress: bool) -> dict[str, Any]:
    """Verify a bundle: files, signature, self-test and gain file; return the JSON document of the result."""
    from tuning.bundle.checking import check_bundle, run_selftest
    from tuning.bundle.signing import load_verifier

    signed_by = None if key is None else load_verifier(arguments.check_path("key", key))
    with jax_context(), terminal.show_stages(2, progress) as stages:
        stages.begin("exporting the bundle again from its gains")
        checked = check_bundle(folder, signed_by)
        document = {"bundle": str(folder), "signature": checked.signature, "self_test": []}
        reasons = checked.reasons
        if not reasons:
            stages.begin("running the bundle's self-test")
            document["self_test"], reasons = run_selftest(checked, os.path.basename(os.path.abspath(folder)))
    if reasons:
        return {**document, "verdict": "bad", "reasons": reasons}
    document, loaded = _verify_gains(
        checked, {**document, "file": str(folder / "gains.json")}, scenarios, seed, progress
    )
    has_rig = any(name.endswith("jaxhil_rig.fmu") for name in checked.files)
    if loaded is None or not has_rig:
        return document
    return _add_fmu_loop(document, checked.files, loaded, progress)


def _add_fmu_loop(document: dict[str, Any], files: Any, loaded: Any, progress: bool) -> dict[str, Any]:
    """Compare a run of the bundle's FMUs with the simulation; add the comparison to the document."""
    import msgspec

    from tuning.bundle.fmu.closed_loop import compare_fmu_loop

    with jax_context(), terminal.show_stages(1, progress) as stages:
        stages.begin("running the nominal contacts with the FMUs")
        loop = compare_fmu_loop(files, loaded)
    if loop is None:
        return {**document, "fmu_loop": None}
    reasons = [*document["reasons"], *loop.reasons]
    return {
        **document,
        "fmu_loop": msgspec.to_builtins(loop),
        "verdict": "bad" if loop.reasons else document["verdict"],
        "reasons": reasons,
    }


def _verify_gains(gains: Any, document: dict[str, Any], scenarios: int, seed: int, progress: bool):
    """Verify a gain file, or gains in memory.

    Return `document` with the result's JSON entries added, and the loaded gains. If the gains are invalid,
    the second value is None.
    """
    with jax_context():
        import msgspec

        try:
            loaded = arguments.load_gains(gains, any_axes=True)
        except InputError as error:
            return {**document, "verdict": "bad", "reasons": [str(error)]}, None
        axes = loaded.document.get("axes", 1)
        arguments.check_has_runtime(loaded.compensator, axes)
        if axes == 6:
            from tuning.verification.six_axes import verify_six_axes as compare
        else:
            from tuning.verification.runtime_replay import verify as compare
        with terminal.show_stages(3, progress) as stages:
            result = compare(loaded, scenarios, seed, stages.begin)
        verdict = "good" if result.verdict else "bad"
        content = {"mechanism": loaded.mechanism.name, **msgspec.to_builtins(result)}
        return {**document, **content, "verdict": verdict}, loaded


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False
