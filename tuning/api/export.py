"""Function `tuning.export`, which writes gains as a bundle that a rig computer can check and run."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import to_builtins
from tyro.conf import arg

from jaxhil.errors import format_value
from jaxhil.rig.limits import LIMITS
from jaxhil.rig.six_axes.limits import SIX_AXIS_LIMITS
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
from tuning.bundle.selftest import SIGNATURE_FILE

if TYPE_CHECKING:
    from tuning.sweeps.store import SweepStore


@dataclass(frozen=True)
class ExportResult:
    """Result of `export`.

    Attributes:
        document: all results, as `jaxhil export --json` prints them.
        sizes: sizes of the bundle's files by file name [bytes].
    """

    document: dict[str, Any]
    sizes: dict[str, int]

    @property
    def verdict(self) -> str:
        """Return the verdict: "good", "bad" or "unknown".

        The verdict is "bad" if the rig's controller differs from the simulated one, or if its watchdog gives
        wrong alarms more often than allowed. It is "unknown" if too few runs are known to determine the rates
        of wrong alarms.
        """
        return self.document["verdict"]

    @property
    def good(self) -> bool:
        """Return whether the verdict is not "bad"; `jaxhil export` then ends with exit code 0."""
        return self.verdict != "bad"

    @property
    def reasons(self) -> list[str]:
        """Return the reasons for a bad verdict; an empty list for any other verdict."""
        return list(self.document["reasons"])

    @property
    def unknown(self) -> list[str]:
        """Return the alarm rates that are unknown, each with the sweep that would determine it.

        The list is empty if the verdict is "good".
        """
        return list(self.document["unknown"])


ALL_LIMITS = {**SIX_AXIS_LIMITS, **LIMITS}  # limits for one axis and for six axes
FmiVersions = AllowedValues(2, 3, words="2 or 3")
ProbabilityRange = AllowedValues(0.0, 1.0, words="0 to 1")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of `export`."""

    false_alarms: Annotated[
        float,
        arg(
            metavar="PROBABILITY",
            help="Acceptable share of good runs (error at most half the limit) that the watchdog stops.",
        ),
        ProbabilityRange,
    ] = 0.01
    missed: Annotated[
        float,
        arg(metavar="PROBABILITY", help="Acceptable share of bad runs that the watchdog does not stop."),
        ProbabilityRange,
    ] = 0.02
    fmi: Annotated[int, number_option("Version of FMI for the format fmu: 2 or 3."), FmiVersions] = 3
    seed: Annotated[int, number_option("Seed of the test vectors."), SeedRange] = 0
    sign: Annotated[
        str | None,
        text_option("KEY", "Sign the bundle with this private key (Ed25519, PEM); needs jaxhil[sign]."),
    ] = None


@arguments.convert_os_errors
@add_options(ExportOptions)
def export(
    gains: Any,
    folder: str | os.PathLike[str],
    *,
    sweep: Any = None,
    formats: Sequence[str] | None = None,
    limits: Mapping[str, float | None] | None = None,
    progress: bool = False,
    **options: Any,
) -> ExportResult:
    """Write a bundle for the rig: gains, a controller without dependencies, test vectors and a self-test.

    Args:
        gains: result of `tuning.tune`, or the path of a gain file or of its folder.
        folder: folder of the bundle: a new or empty folder, or an earlier bundle, which is replaced.
        sweep: result of `tuning.sweep` for these gains, or the folder with such a result. Limits and alarm
            rates are computed from its runs.
        formats: additional formats of the gains: "ros2", "matlab", "csv", "c99", "fmu",
            "rehearsal"; None: all but the last two.
        limits: limits of this rig by name [SI units], which replace the computed limits; a value of None
            removes a limit.
        progress: report the progress on standard error.
        **options: see `ExportOptions`.

    Returns:
        The verdict with its reasons, all results, and the sizes of the files.

    Raises:
        InputError: If an argument is unusable, the compensator has no runtime for the rig, or the folder
            cannot be written; the message has one line.

    Example:
        >>> import tempfile
        >>> import tuning
        >>> tuned = tuning.tune("rig-300kg", "phase_lead", scenarios=4, starts=1, validation=4)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     exported = tuning.export(tuned, folder, formats=["c99"])
        >>> "gains.json" in exported.sizes
        True
    """
    settings = ExportOptions(**options)
    check_options(settings)
    arguments.check_booleans(progress=progress)
    from tuning.bundle.bundle import build_bundle, check_bundle_folder, check_same_mechanism, write_bundle
    from tuning.bundle.signing import load_signer

    target = arguments.check_path("folder", folder)
    user_limits = _parse_limits({} if limits is None else limits)
    path = gains if hasattr(gains, "document") else arguments.find_gain_file(gains)
    _check_formats(formats)
    check_bundle_folder(target)
    key = None if settings.sign is None else load_signer(arguments.check_path("sign", settings.sign))
    with jax_context():
        loaded = arguments.load_gains(path, any_axes=True)
        axes = loaded.document.get("axes", 1)
        arguments.check_has_runtime(loaded.compensator, axes)
        _check_limit_names(user_limits, axes)
        check_same_mechanism(target, loaded.mechanism.name)
        format_names = _select_formats(formats, settings.fmi)
        allowed = settings.false_alarms, settings.missed
        from tuning.sweeps.run_sweep import summarise_failures

        content = loaded.document
        with _open_sweep(sweep) as store:
            calibration = _calibrate_limits(loaded, store, user_limits, allowed, progress)
            if store is not None:
                content = {**content, "figures": {**content["figures"], "sweep": summarise_failures(store)}}
        limits_and_rates = calibration.limits, calibration.rates
        with terminal.show_stages(2, progress) as stages:
            bundle = build_bundle(content, format_names, *limits_and_rates, settings.seed, stages.begin, key)
            if not bundle.reasons:
                write_bundle(target, bundle.files)
    document = _build_document(loaded, bundle, format_names, calibration.rates)
    document["bundle"] = None if bundle.reasons else str(target)
    return ExportResult(document, {name: len(content) for name, content in bundle.files.items()})


def _build_document(loaded, bundle, format_names, rates) -> dict[str, Any]:
    """Return the JSON document of the export, without the path of the bundle (its entry is None)."""
    from tuning.bundle.writers import describe_fmus
    from tuning.verification.stops import describe_limit_changes

    stops = []
    if bundle.stop is not None:
        # If the limits stop the nominal run in the simulation, they also stop it on the rig.
        stops = [f"the nominal run is {bundle.stop.text}; {describe_limit_changes(bundle.passing)}"]
    elif bundle.ended and bundle.ended[0]:
        stops = [f"the nominal run, {bundle.ended[0]}"]
    reasons = [*bundle.reasons, *stops, *rates["reasons"]]
    return {
        "bundle": None,
        "mechanism": loaded.mechanism.name,
        "axes": bundle.document.get("axes", 1),
        "compensator": loaded.compensator,
        "gains_sha256": bundle.document["sha256"],
        "formats": ["fmu" if name == "fmu2" else name for name in format_names],
        "files": sorted(bundle.files),
        "fmu_notes": describe_fmus(bundle.document, bundle.files),
        "signed": SIGNATURE_FILE in bundle.files,
        "limits": bundle.document.get("limits"),
        "rates": rates,
        "sweep": bundle.document["figures"].get("sweep"),
        "ticks": bundle.ticks,
        "runs": bundle.runs,
        "ended": bundle.ended,
        "stop": None if bundle.stop is None else {**to_builtins(bundle.stop), "passing": bundle.passing},
        "reasons": reasons,
        "unknown": rates["unknown"],
        "verdict": "bad" if reasons else rates["verdict"],
    }


def _calibrate_limits(
    loaded,
    store: "SweepStore | None",
    replaced: dict[str, float | None],
    allowed: tuple[float, float],
    progress,
):
    """Compute the watchdog's limits, and its rates of false and missed alarms.

    `replaced` contains the limits that the user set; `allowed` contains the acceptable values of both rates.
    """
    from tuning.watchdog.verdict import AllowedAlarmRates

    rates = AllowedAlarmRates(*allowed)
    if loaded.document.get("axes", 1) == 6:
        from tuning.watchdog.six_axes import SIX_AXIS_DRAWS, calibrate_six_axes

        with terminal.show_progress(SIX_AXIS_DRAWS, "runs", progress) as bar:
            bar.reach(0, "computing the limits")
            return calibrate_six_axes(loaded, store, replaced, rates, bar.advance)
    from tuning.watchdog.calibration import DEFAULT_DRAWS, calibrate, count_stored_scenarios
    from tuning.watchdog.fault_injection import INJECTED_FAULTS, count_fault_scenarios

    faulty = count_fault_scenarios(allowed[1])
    runs = DEFAULT_DRAWS if store is None else count_stored_scenarios(store)
    with terminal.show_progress(runs + len(INJECTED_FAULTS) * faulty, "runs", progress) as bar:
        bar.reach(0, "computing the limits")
        return calibrate(loaded, store, replaced=replaced, allowed=rates, progress=bar.advance, faulty=faulty)


def _check_limit_names(limits: Mapping[str, Any], axes: int) -> None:
    """Raise `InputError` if a limit does not exist for a controller with this number of axes."""
    from tuning.bundle.controller_kind import kind_of

    table = kind_of({"axes": axes}).limits
    for name in limits:
        if name not in table:
            raise ArgumentError("limits", format_value(name), f"one of {', '.join(table)}")


@contextmanager
def _open_sweep(sweep: Any) -> "Iterator[SweepStore | None]":
    """Open the rows of a sweep, which is a result of `tuning.sweep` or its folder; None without a sweep."""
    from tuning.api.sweep import SweepStudy
    from tuning.sweeps.store import read_store

    if isinstance(sweep, SweepStudy):
        with sweep.store() as store:
            yield store
    else:
        yield None if sweep is None else read_store(arguments.check_path("sweep", sweep))


def _parse_limits(limits: Any) -> dict[str, float | None]:
    """Check the watchdog limits that the user set, and return them by name; None removes a limit.

    Raise `InputError` if a name or a value is not allowed.
    """
    if not isinstance(limits, Mapping):
        raise ArgumentError("limits", format_value(limits), "a dict from names of limits to values")
    for name, value in limits.items():
        if name not in ALL_LIMITS:
            raise ArgumentError("limits", format_value(name), f"one of {', '.join(LIMITS)}")
        if value is not None and not (arguments.is_number(value) and ALL_LIMITS[name].admits(value)):
            raise ArgumentError("limits", format_value(value), allowed_values(name), name)
    return {name: None if value is None else float(value) for name, value in limits.items()}


def allowed_values(name: str) -> str:
    """Return a text that describes the values that the user may set for the watchdog's limit `name`."""
    limit = ALL_LIMITS[name]
    return f"a finite number from {limit.lowest:g} to {limit.highest:g} {limit.unit}, or none"


def _check_formats(formats: Any) -> None:
    from tuning.bundle.writers import WRITERS

    for name in formats or ():
        arguments.check_choice(tuple(name for name in WRITERS if name != "fmu2"), format=name)


def _select_formats(formats: Sequence[str] | None, fmi: int) -> list[str]:
    """Return the requested formats in the order of `WRITERS`; by default all but those in `ON_REQUEST`."""
    from tuning.bundle.writers import ON_REQUEST, WRITERS

    names = formats or [name for name in WRITERS if name not in ON_REQUEST]
    chosen = ["fmu2" if name == "fmu" and fmi == 2 else name for name in names]
    return [name for name in WRITERS if name in chosen]
