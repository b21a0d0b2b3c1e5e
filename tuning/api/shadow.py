"""Function `tuning.shadow`, which shows what a controller would have commanded on the readings of logs."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff

from jaxhil.errors import InputError, format_value
from jaxhil.files import report_write_errors, resolve_output_path
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments
from tuning.api.options import add_options, check_options, text_option

if TYPE_CHECKING:
    from tuning.shadow_mode.comparison import ShadowComparison

SCHEMA = "jaxhil/shadow/1"


@dataclass(frozen=True)
class ShadowResult:
    """Result of `shadow`.

    Attributes:
        document: all results, as `jaxhil shadow --json` prints them.
        comparison: contacts, findings, logged ticks and the controller's commands
            (`tuning.shadow_mode.comparison.ShadowComparison`).
    """

    document: dict[str, Any]
    comparison: "ShadowComparison" = field(repr=False)

    @property
    def good(self) -> bool:
        """Return True unless the controller would have tripped."""
        return self.document["verdict"] == "good"

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Write a plot of the controller's and the logged commands to a .png, .pdf or .svg file.

        Raises:
            InputError: If the file cannot be written.
        """
        from jaxhil.simulation.contact_plot import save_figure
        from tuning.plots.shadow import shadow_plot

        title = f"{self.document['mechanism']}, {self.document['compensator']}: commands in shadow mode"
        target = arguments.check_path("path", path)
        with report_write_errors(target):
            save_figure(shadow_plot(self.comparison, title), resolve_output_path(target))


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    """Options of `shadow`."""

    session: Annotated[
        FlagCreatePairsOff[bool],
        text_option(
            None,
            "All logs belong to one session: the controller keeps what it has identified from log to log. "
            "By default, each log has a new controller.",
        ),
    ] = False


@arguments.convert_os_errors
@add_options(ShadowOptions)
def shadow(
    gains: Any,
    logs: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    map: str | os.PathLike[str] | None = None,
    progress: bool = False,
    **options: Any,
) -> ShadowResult:
    """Show what a controller would have commanded on the readings in a rig's logs.

    The Python controller of the bundle or gain file gets the readings tick by tick, with the time stamps of
    the log. No command is sent to a rig.

    Args:
        gains: path of a bundle, of a gain file, or of its folder; or a result of `tuning.tune`.
        logs: path of a log, or paths of several logs, in any format that `jaxhil identify` reads.
        map: path of the TOML file that states the meaning of the columns; None for the columns of
            `jaxhil simulate --log`.
        progress: report the progress on standard error.
        **options: see `ShadowOptions`.

    Returns:
        For each contact, the differences from the logged commands, and the controller's faults, trip and
        status. For all contacts, causes of the differences.

    Raises:
        InputError: If an argument, the bundle or a log is unusable; the message has one line.

    Example:
        >>> import tempfile
        >>> import jaxhil, tuning
        >>> tuned = tuning.tune("rig-300kg", "phase_lead", scenarios=4, starts=1, validation=4)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     jaxhil.simulate(tuned.mechanism, "phase_lead", tuned.gains).to_csv(f"{folder}/run.csv")
        ...     result = tuning.shadow(tuned, f"{folder}/run.csv")
        >>> result.good, result.document["contacts"][0]["share"] < 1e-12
        (True, True)
    """
    settings = ShadowOptions(**options)
    check_options(settings)
    arguments.check_booleans(progress=progress)
    with jax_context():
        loaded = arguments.load_gains(gains, any_axes=True)
        make_controller = _prepare_controller(gains, loaded)
    paths = _list_logs(logs)
    with jax_context(), terminal.show_stages(2, progress) as stages:
        from tuning.shadow_mode.comparison import compare_with_logs
        from tuning.shadow_mode.logged_ticks import read_logged_ticks

        stages.begin("reading the logs")
        mapping = _load_mapping(map, loaded.document.get("axes", 1))
        try:
            ticks = read_logged_ticks(paths, mapping, loaded.mechanism)
        except InputError as error:
            hint = (
                " (describe the columns in a mapping file; pass it with --map or as `map`)"
                if map is None
                else ""
            )
            raise InputError(f"{error}{hint}") from None
        stages.begin(f"feeding {sum(len(log.tick) for log in ticks)} ticks to the controller")
        comparison = compare_with_logs(make_controller, ticks, loaded.mechanism, settings.session)
    return ShadowResult(_build_document(loaded, comparison), comparison)


def _list_logs(logs: Any) -> list[Path]:
    listed, _ = arguments.as_list(logs, (str, os.PathLike))
    if not listed:
        raise InputError("logs: found none, expected one or more files")
    return [arguments.check_path("logs", log) for log in listed]


def _prepare_controller(gains: Any, loaded: Any) -> Callable[[Sequence[str]], Any]:
    """Return a function that makes controllers; if `gains` is a bundle, check the bundle's code first.

    The function gets names of limits. Its controller uses the defaults of these limits, and otherwise the
    limits of the gain file.
    """
    from tuning.bundle.checking import check_bundle_code
    from tuning.bundle.controller_kind import kind_of

    kind = kind_of(loaded.document)
    arguments.check_has_runtime(loaded.compensator, kind.axes)
    if isinstance(gains, (str, os.PathLike)):
        # If the check passes, this package's code behaves like the bundle's code and runs in its place.
        check_bundle_code(Path(gains), loaded.compensator, kind.axes)
    gain_file = kind.check_document(loaded.document)

    def make_controller(unlimited: Sequence[str]) -> Any:
        widest = {name: kind.limits[name].default for name in unlimited if name in kind.limits}
        return kind.controller(gain_file._replace(limits={**gain_file.limits, **widest}))

    return make_controller


def _load_mapping(path: Any, axes: int) -> Any:
    """Return the mapping, which describes the logs; without a path, that for logs of `jaxhil simulate`."""
    from tuning.identification.logs import mapping, six_axis_mapping

    if path is None:
        is_six = axes == 6
        return (
            six_axis_mapping.make_six_axis_simulation_mapping()
            if is_six
            else mapping.make_simulation_mapping()
        )
    load = six_axis_mapping.load_six_axis_mapping if axes == 6 else mapping.load_mapping
    return load(arguments.check_path("map", path))


def _build_document(loaded: Any, comparison: "ShadowComparison") -> dict[str, Any]:
    """Return the JSON document of the comparison between a controller and logs."""
    import msgspec

    contacts = comparison.contacts
    tripped = [contact for contact in contacts if contact.trip is not None]
    return terminal.to_json_data({
        "schema": SCHEMA,
        "mechanism": loaded.mechanism.name,
        "compensator": loaded.compensator,
        "axes": loaded.document.get("axes", 1),
        "gains_sha256": loaded.document["sha256"],
        "contacts": msgspec.to_builtins(contacts),
        "findings": list(comparison.findings),
        "notes": list(comparison.notes),
        "verdict": "bad" if tripped else "good",
        "reasons": [
            f"contact {contact.contact} of {format_value(contact.log)}: the controller would have "
            f"{contact.trip.reason}, at {contact.trip.time:.4f} s"
            for contact in tripped
            if contact.trip is not None
        ],
    })  # fmt: skip
