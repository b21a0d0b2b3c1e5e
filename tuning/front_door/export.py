"""`tuning.export`: gains as a bundle that a rig computer can check and run by itself."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import to_builtins
from tyro.conf import arg

from jaxhil.errors import shown
from jaxhil.rig.limits import LIMITS
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.bundle.selftest import SIGNATURE
from tuning.front_door import arguments
from tuning.front_door.arguments import ArgumentError
from tuning.front_door.options import Allowed, Seed, check_options, number, takes, text

if TYPE_CHECKING:
    from tuning.sweeps.store import Store


@dataclass(frozen=True)
class Exported:
    """What `export` returns.

    document: all that is known, as `jaxhil export --json` prints it.
    sizes: bytes of each of the bundle's files.
    """

    document: dict[str, Any]
    sizes: dict[str, int]

    @property
    def verdict(self) -> str:
        """ "good"; "bad" if the controller on the rig does not do what was simulated, or raises wrong alarms
        more often than allowed; "unknown" if nothing is bad, but too few runs say how often it does."""
        return self.document["verdict"]

    @property
    def good(self) -> bool:
        """Whether nothing was found to be bad: the exit code 0 of `jaxhil export`."""
        return self.verdict != "bad"

    @property
    def reasons(self) -> list[str]:
        """Why it is bad; none if it is not."""
        return list(self.document["reasons"])

    @property
    def unknown(self) -> list[str]:
        """What is not known, and which sweep would tell; nothing if it is good."""
        return list(self.document["unknown"])


Probability = Allowed(0.0, 1.0, words="0 to 1")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of `export`."""

    false_alarms: Annotated[
        float,
        arg(
            metavar="PROBABILITY", help="Acceptable share of good runs (error up to half the limit) stopped."
        ),
        Probability,
    ] = 0.01
    missed: Annotated[
        float,
        arg(metavar="PROBABILITY", help="Acceptable share of runs to be stopped that the watchdog misses."),
        Probability,
    ] = 0.02
    seed: Annotated[int, number("Seed of the test vectors."), Seed] = 0
    sign: Annotated[
        str | None,
        text("KEY", "Sign the bundle with this private key (Ed25519, PEM); needs jaxhil[sign]."),
    ] = None


@arguments.entry
@takes(ExportOptions)
def export(
    gains: Any,
    folder: str | os.PathLike[str],
    *,
    sweep: Any = None,
    formats: Sequence[str] | None = None,
    limits: Mapping[str, float | None] | None = None,
    progress: bool = False,
    **options: Any,
) -> Exported:
    """Write a bundle for the rig: gains, controller, test vectors, self-test; nothing to install there.

    Args:
        gains: what `tuning.tune` returned, or a gain file's path, or its folder's.
        folder: where to write the bundle: new, empty, or a bundle, which is replaced.
        sweep: what `tuning.sweep` returned for these gains, or its store's folder: limits and the watchdog's
            rates come from it.
        formats: also the gains for "ros2", "matlab", "csv", "c99"; None: all.
        limits: limits of the rig's own by name [SI units], None for no limit, instead of those worked out.
        progress: say on standard error what is going on.
    OPTIONS

    Raises:
        InputError: one line, for an argument that will not do, a law without a runtime, or a folder that
            cannot be written.
    """
    asked = ExportOptions(**options)
    check_options(asked)
    arguments.flags(progress=progress)
    from tuning.bundle.bundle import build_bundle, check_mechanism, check_target, write_bundle
    from tuning.bundle.signing import signer

    target = arguments.folder("folder", folder)
    replaced = _replaced({} if limits is None else limits)
    path = gains if hasattr(gains, "document") else arguments.readable_gain_file(gains)
    _check_formats(formats)
    check_target(target)
    key = None if asked.sign is None else signer(arguments.folder("sign", asked.sign))
    with computing():
        loaded = arguments.gain_file(path)
        arguments.runtime(loaded.compensator)
        check_mechanism(target, loaded.mechanism.name)
        chosen = _formats(formats)
        found = _calibrated(loaded, sweep, replaced, (asked.false_alarms, asked.missed), progress)
        with terminal.stages(2, progress) as stages:
            bundle = build_bundle(
                loaded.document, chosen, found.limits, found.rates, asked.seed, stages.begin, key
            )
            if not bundle.reasons:
                write_bundle(target, bundle.files)
    document = _document(loaded, bundle, chosen, found.rates)
    document["bundle"] = None if bundle.reasons else str(target)
    return Exported(document, {name: len(content) for name, content in bundle.files.items()})


def _document(loaded, bundle, chosen, rates) -> dict[str, Any]:
    """What `jaxhil export --json` prints, but for where the bundle is."""
    from tuning.verification.stops import advice

    stops = []
    if bundle.stop is not None:
        # What the limits stop here they stop on the rig.
        stops = [f"the nominal run is {bundle.stop.text}; {advice(bundle.passing)}"]
    elif bundle.ended and bundle.ended[0]:
        stops = [f"the nominal run, {bundle.ended[0]}"]
    reasons = [*bundle.reasons, *stops, *rates["reasons"]]
    return {
        "bundle": None,
        "mechanism": loaded.mechanism.name,
        "compensator": loaded.compensator,
        "gains_sha256": bundle.document["sha256"],
        "formats": chosen,
        "files": sorted(bundle.files),
        "signed": SIGNATURE in bundle.files,
        "limits": bundle.document.get("limits"),
        "rates": rates,
        "ticks": bundle.ticks,
        "runs": bundle.runs,
        "ended": bundle.ended,
        "stop": None if bundle.stop is None else {**to_builtins(bundle.stop), "passing": bundle.passing},
        "reasons": reasons,
        "unknown": rates["unknown"],
        "verdict": "bad" if reasons else rates["verdict"],
    }


def _calibrated(
    loaded, sweep: Any, replaced: dict[str, float | None], allowed: tuple[float, float], progress: bool
):
    """The limits for the rig, and what is known of the watchdog's alarms."""
    from tuning.watchdog.calibration import WITHOUT_STORE, calibrate, held_scenarios
    from tuning.watchdog.fault_runs import FAULTS, scenarios_needed
    from tuning.watchdog.verdict import Allowed

    faulty = scenarios_needed(allowed[1])
    with _store(sweep) as store:
        runs = WITHOUT_STORE if store is None else held_scenarios(store)
        with terminal.progress(runs + len(FAULTS) * faulty, "runs", progress) as bar:
            bar.reach(0, "working out the limits")
            return calibrate(
                loaded,
                store,
                replaced=replaced,
                allowed=Allowed(*allowed),
                progress=bar.advance,
                faulty=faulty,
            )


@contextmanager
def _store(sweep: Any) -> "Iterator[Store | None]":
    """The rows of a sweep, if there is one."""
    from tuning.front_door.sweep import SweepStudy
    from tuning.sweeps.store import read_store

    if isinstance(sweep, SweepStudy):
        with sweep.store() as store:
            yield store
    else:
        yield None if sweep is None else read_store(arguments.folder("sweep", sweep))


def _replaced(given: Any) -> dict[str, float | None]:
    """The limits that the user sets, None for no limit. Raises `InputError`."""
    if not isinstance(given, Mapping):
        raise ArgumentError("limits", shown(given), "limits by name")
    for name, value in given.items():
        if name not in LIMITS:
            raise ArgumentError("limits", shown(name), f"one of {', '.join(LIMITS)}")
        if value is not None and not (arguments.is_number(value) and LIMITS[name].admits(value)):
            raise ArgumentError("limits", shown(value), allowed_values(name), name)
    return {name: None if value is None else float(value) for name, value in given.items()}


def allowed_values(name: str) -> str:
    """What a limit may be set to, in words."""
    limit = LIMITS[name]
    return f"a finite number from {limit.lowest:g} to {limit.highest:g} {limit.unit}, or none"


def _check_formats(formats: Any) -> None:
    """Raises `InputError` for a format that there is not."""
    from tuning.bundle.writers import WRITERS

    for name in formats or ():
        arguments.one_of(tuple(WRITERS), format=name)


def _formats(formats: Sequence[str] | None) -> list[str]:
    """Return the formats asked for, in the order of the table; by default all."""
    from tuning.bundle.writers import WRITERS

    return [name for name in WRITERS if not formats or name in formats]
