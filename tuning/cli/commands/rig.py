"""Command `jaxhil rig`: runs the controller against a simulated rig in real time over UDP."""

import math
import sys
import tempfile
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, to_one_line
from jaxhil.files import resolve_output_path
from tuning import terminal
from tuning.api import arguments
from tuning.cli.commands import checks
from tuning.cli.options_rig import RigOptions

MAX_EMPTY_LOOP_DURATION = 30.0  # longest duration of the empty loop, which only exchanges packets [s]
EMPTY_LOOP_SHARE = 0.2  # duration of the empty loop, divided by the run's duration
MAX_TICKS = 2_000_000  # largest number of ticks in a run
MINIMUM_RATE = 1e-3  # at this rate, a run of 10 s takes almost 3 hours [1]
MIN_PACKETS = 10  # smallest number of packets in the time after which a running controller ends
MAX_TABLE_ROWS = 12  # largest number of contacts in the printed table


def run(options: RigOptions) -> int:
    """Run an empty loop, which only exchanges packets, then the controller, and print the result.

    Return exit code 0 if the verdict is good, 130 after an interrupted run, else 1.
    """
    _check_options(options)
    gains = arguments.find_gain_file(options.path)
    document, mechanism, stroke = load_checked_gains(gains)
    axes = document.get("axes", 1)
    from tuning.bundle.checking import check_bundle_code

    check_bundle_code(Path(options.path), document["compensator"], axes)
    limit = arguments.choose_limit(options.limit, mechanism)
    period = mechanism.rig.control_period
    _check_timing(options, period)

    from tuning.rig.network import Injection
    from tuning.rig.rig_task import build_simulated_rig
    from tuning.rig.session import SessionSettings, run_session
    from tuning.rig.session_report import evaluate_session

    with tempfile.TemporaryDirectory(prefix="jaxhil-rig-") as temporary:
        scratch = Path(temporary)
        setup = SessionSettings(
            folder=write_controller_files(document["compensator"], axes, scratch),
            gains=gains,
            mechanism=mechanism,
            stroke=stroke,
            duration=options.duration,
            empty_duration=min(MAX_EMPTY_LOOP_DURATION, EMPTY_LOOP_SHARE * options.duration),
            injection=Injection(options.drops, options.jitter, options.delay),
            seed=options.seed,
            priority=options.realtime,
            port=options.connect,
            rate=options.rate,
        )
        rig = build_simulated_rig(mechanism, options.seed)
        session = run_session(setup, rig, scratch, terminal.note, _LoopProgress(period).tell)
    # For one axis, only the next function imports jax, which would disturb the real-time loop.
    result = evaluate_session(setup, rig, session, limit, document["compensator"])
    if options.plot is not None:
        from jaxhil.simulation.contact_plot import save_figure
        from tuning.plots.latency import latency_plot

        title = f"{mechanism.name}, {document['compensator']}: latencies at {1 / period:g} Hz over UDP"
        save_figure(latency_plot(session, title, period), resolve_output_path(options.plot))
        terminal.note(f"wrote {options.plot}")
    if options.json:
        verdict = {"verdict": terminal.INTERRUPTED} if session.interrupted else {}
        terminal.emit_json("rig", {**result, **verdict})
    else:
        _print(result)
        if result["verdict"] == "good":
            terminal.suggest("report", options.path)
        elif options.plot is None:
            terminal.suggest("rig", options.path, "--plot")
    if session.interrupted:
        terminal.note("jaxhil: interrupted")
        return 130
    return 0 if result["verdict"] == "good" else 1


def write_controller_files(compensator: str, axes: int, scratch: Path) -> Path:
    """Write the code of the controller's process, as in a bundle, to `scratch`; return this folder."""
    from tuning.bundle.content import code_files

    for name, content in code_files(compensator, axes).items():
        (scratch / name).write_bytes(content)
    return scratch


def load_checked_gains(gains: Path) -> tuple[dict[str, Any], Any, tuple[Any, Any]]:
    """Check a gain file as the rig's runtime does.

    Return the file's document and mechanism, and the lowest and the highest position commands [m, rad] that
    the file allows. Raise `InputError` if a check fails.
    """
    from jaxhil.mechanism.file import any_from_plain_data
    from jaxhil.mechanism.six_axes import is_six_axes
    from jaxhil.rig import GainFileError
    from jaxhil.rig.gain_document import read_gain_document
    from tuning.bundle.controller_kind import kind_of

    source = to_one_line(str(gains))
    try:
        document = read_gain_document(gains)
        kind, mechanism = kind_of(document), document.get("mechanism")
        if isinstance(mechanism, dict) and is_six_axes(mechanism) != (kind.axes == 6):
            other = 7 - kind.axes
            raise InputError(
                f"{source}: mechanism: found {other} axes, expected {kind.axes} like the controller"
            )
        limits = kind.check_document(document, source).limits
    except GainFileError as error:
        raise InputError(str(error)) from None
    mechanism = any_from_plain_data(document["mechanism"], f"{source}: mechanism")
    lowest, highest = (tuple(limits[name] for name in names) for names in kind.stroke)
    return document, mechanism, (lowest, highest)


class _LoopProgress:
    """Progress display of the real-time loop; the texts are short, because writing takes the loop's time."""

    def __init__(self, period: float) -> None:
        self._period, self._terminal = period, sys.stderr.isatty()

    def tell(self, done: int, total: int) -> None:
        """Write the elapsed and the total time to standard error; `done` and `total` are numbers of ticks."""
        seconds = round(done * self._period)
        if self._terminal:
            sys.stderr.write(f"\r{seconds} of {total * self._period:.0f} s \r")
            sys.stderr.flush()
        elif seconds and seconds % 60 == 0:
            sys.stderr.write(f"{seconds} of {total * self._period:.0f} s\n")
            sys.stderr.flush()


def _check_options(options: RigOptions) -> None:
    """Check the options that need neither the gain file nor the mechanism; raise `InputError`."""
    arguments.check_limit(options.limit)
    arguments.check_integers(0, seed=options.seed)
    _check_injection(options)
    if options.connect is not None:
        arguments.check_integers(1, 65535, connect=options.connect)
    if options.plot is not None:
        checks.check_plot(options.plot)


def _check_timing(options: RigOptions, period: float) -> None:
    """Check duration, rate and priority for a control period [s]; raise `InputError`."""
    if not period <= options.duration <= MAX_TICKS * period:
        allowed = f"{period:g} to {MAX_TICKS * period:g} s, {MAX_TICKS} control periods"
        raise InputError(f"--duration: found {options.duration:g}, expected {allowed}")
    from tuning.rig.session import SILENCE_TIMEOUT, real_time_priority

    slowest = MIN_PACKETS * period / SILENCE_TIMEOUT
    if options.connect is not None and options.rate < slowest:
        raise InputError(
            f"--rate: found {options.rate:g}, expected {slowest:g} to 1 with --connect, because a running "
            f"controller ends after {SILENCE_TIMEOUT:g} s without a packet"
        )
    try:
        with real_time_priority(options.realtime):
            pass
    except OSError as error:
        reason = to_one_line(error.strerror or str(error), 100)
        raise InputError(
            f"--realtime: found no permission for real-time priority ({reason}), expected this permission: "
            "grant it, or run without --realtime"
        ) from None


def _check_injection(options: RigOptions) -> None:
    """Raise `InputError` if the rate, or a probability or delay of the injected faults, is not allowed."""
    if not MINIMUM_RATE <= options.rate <= 1.0:
        raise InputError(f"--rate: found {options.rate:g}, expected {MINIMUM_RATE:g} to 1")
    if not 0.0 <= options.drops < 1.0:
        raise InputError(f"--drops: found {options.drops:g}, expected a probability >= 0 and < 1")
    for name in ("jitter", "delay"):
        value = getattr(options, name)
        if not 0.0 <= value <= 1.0:
            raise InputError(f"--{name}: found {value:g}, expected 0 to 1 s")


def _print(document: dict[str, Any]) -> None:
    loops = {"empty loop": document["empty_loop"], "controller": document["run"]}
    recorded = {name: loop for name, loop in loops.items() if loop is not None}
    terminal.emit(*_build_tables(document, recorded), *_session_remarks(document, recorded))


def _build_tables(document: dict[str, Any], loops: dict[str, Any]) -> list[Any]:
    """Return the tables of missed ticks and computing times of all loops, and the table of contacts."""
    rate = f"{document['rate'] / document['control_period']:g} Hz over UDP"
    ticks = terminal.build_table(
        f"{document['mechanism']}, {document['compensator']}, {rate}: ticks",
        ["loop", "ticks", "missed", "controller's fault", "injected", "the machine's"],
        [
            (
                name,
                *(
                    loop[key]
                    for key in ("ticks", "missed", *(f"missed_by_{cause}" for cause in _MISS_CAUSES))
                ),
            )
            for name, loop in loops.items()
        ],
    )
    times = terminal.build_table(
        "Times [µs]: median, 99.9th percentile, maximum",
        ["", "loop", "median", "99.9 %", "maximum"],
        [
            (label, name, *(_format_microseconds(value) for value in loop[key].values()))
            for key, label in _TIME_LABELS.items()
            for name, loop in loops.items()
        ],
        texts=(0, 1),
    )
    headings, row = _CONTACT_TABLES[document["axes"]]
    rows = [
        (number, *row(contact), contact["status"])
        for number, contact in enumerate(document["contacts"][:MAX_TABLE_ROWS], start=1)
    ]
    contacts = terminal.build_table(
        f"Contacts: {len(document['contacts'])}",
        ["contact", *headings, "status"],
        rows,
        texts=(len(headings) + 1,),
    )
    return [ticks, times, *([contacts] if rows else [])]


def _format_microseconds(time: float) -> str:
    """Return a time in microseconds; a dash if it was not measured."""
    return "-" if math.isnan(time) else f"{1e6 * time:.1f}"


def _one_axis_row(contact: dict[str, Any]) -> tuple[Any, ...]:
    """Return the entries of a contact's row in the table for one axis."""
    return (
        contact["number"] + 1,
        terminal.format_number(contact["restitution"], 5),
        terminal.format_number(contact["reference_restitution"], 5),
        terminal.format_error(contact["error"]),
        contact["peak_force"],
        1e3 * contact["duration"],
    )


def _six_axis_row(contact: dict[str, Any]) -> tuple[Any, ...]:
    """Return the entries of an episode's row in the table for six axes."""
    return (
        contact["run"] + 1,
        f"{contact['energy_error']:+.4f}",
        f"{contact['twist_error']:.4f}",
        contact["peak_force"],
        contact["peak_moment"],
        1e3 * contact["duration"],
        contact["touches"],
    )


# By number of axes: headings of the columns after "contact" and before "status", and the function that
# returns their entries.
_CONTACT_TABLES = {
    1: (["in file", "e", "e*", "error", "peak force [N]", "duration [ms]"], _one_axis_row),
    6: (
        ["run", "energy error", "twist error", "peak [N]", "peak [N m]", "in touch [ms]", "touches"],
        _six_axis_row,
    ),
}


def _session_remarks(document: dict[str, Any], loops: dict[str, Any]) -> list[str]:
    """Return the sentences below the tables; the last sentences state the verdict and its reasons."""
    lines = []
    if len(document["contacts"]) > MAX_TABLE_ROWS:
        lines.append(f"... and {len(document['contacts']) - MAX_TABLE_ROWS} more contacts.")
    if document["largest_error"] is not None:
        lines.append(f"Largest error of {document['judged']} contacts: {document['largest_error']:+.5f}.")
    lines += [
        f"{loop['replayed']} ticks of the controller exceeded their CPU time; when the same packets were "
        f"processed again, a tick took at most {1e6 * loop['replayed_most']:.0f} µs."
        for loop in loops.values()
        if loop["replayed"]
    ]
    if document["stalled"]:
        lines.append(
            f"{document['stalled']} contacts are not evaluated: the computer did not run the controller "
            "for more than three periods."
        )
    if document["resets"]:
        lines.append(
            f"The controller tripped {len(document['resets'])} times because of this, and was reset."
        )
    lines += [
        f"The computer stopped the simulated rig ({name}): its clock stood still for "
        f"{loop['stood_still']:.3g} s."
        for name, loop in loops.items()
        if loop["stood_still"] > 0
    ]
    flags = document["run"]["controller"]["doubts"] if document["run"] is not None else {}
    if flags:
        counts = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in flags.items())
        lines.append(f"The compensator reports quality flags for {sum(flags.values())} contacts: {counts}.")
    if document["tripped"]:
        lines.append(f"The controller {document['tripped']}.")
    if document["interrupted"]:
        lines.append("Interrupted: the results are those of the time before the interruption.")
    return lines + ([f"Bad: {reason}" for reason in document["reasons"]] or [f"Good: {document['good']}"])


_MISS_CAUSES = ("controller", "injection", "machine")
_TIME_LABELS = {
    "tick_time": "controller, per tick",
    "tick_cpu": "of it CPU",
    "round_trip": "round trip",
    "lateness": "packet left late by",
}
