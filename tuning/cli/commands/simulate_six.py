"""Command `jaxhil simulate` for a six-axis mechanism."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning import terminal
from tuning.api import arguments
from tuning.cli.commands import checks
from tuning.cli.commands.choice import suggest_next
from tuning.cli.options import SimulateOptions

if TYPE_CHECKING:
    from jaxhil.sixdof.run import Episode, SixAxisRun

ANIMATION_SUFFIXES = (".gif", ".mp4")
GOOD_STATUSES = ("rebounded", "captured")  # statuses of a run that ended well


def check_six_axis_options(options: SimulateOptions) -> None:
    """Raise `InputError` if an option is set that a six-axis simulation does not support."""
    if options.setting is not None:
        found = f"--setting: found {format_value(options.setting)}"
        raise InputError(f"{found}, expected none: compensators have no settings for six axes")
    if options.reference:
        for key in ("compensator", "gains", "plot", "animate", "log"):
            value = getattr(options, key)
            if value is not None:
                raise InputError(
                    f"--{key}: found {format_value(str(value))}, expected none together with --reference"
                )
    if options.animate is not None:
        _check_animation_path(options.animate)


def _check_animation_path(path: str) -> None:
    """Raise `InputError` if an animation cannot be written to `path`; create its parent folders."""
    suffix = Path(path).suffix.lower()
    if suffix not in ANIMATION_SUFFIXES:
        raise InputError(
            f"--animate: found {format_value(path)}, expected a name that ends in "
            f"{', '.join(ANIMATION_SUFFIXES)}"
        )
    if suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError(
            f"--animate: found {format_value(path)}, expected .gif: .mp4 needs ffmpeg, which is not installed"
        )
    checks.check_file_path(path)


def run(options: SimulateOptions, mechanism: SixAxisMechanism) -> int:
    """Simulate the episodes of contact, and print a table of episodes and the verdict.

    Return exit code 0 if the run ended well, and all twist errors, real peak forces and times in contact are
    within their limits. Otherwise return 1.
    """
    if options.reference:
        return _run_ideal_contact(options, mechanism)
    from jaxhil.sixdof.run import simulate_six_axes

    gains = None if options.gains is None else Path(options.gains)
    result = simulate_six_axes(mechanism, options.compensator or "none", gains, seed=options.seed)
    limit = arguments.choose_limit(options.limit, mechanism)
    good = result.status in GOOD_STATUSES and _worst_twist_error(result) <= limit
    good = good and not any(_is_unlike_ideal(result))
    terminal.warn(f"{mechanism.name}: {warning}" for warning in result.summary.warnings)
    _write(options, result)
    _write_one_axis_file(options, mechanism, result.episodes[0])
    if options.json:
        terminal.emit_json("simulate", _build_document(limit, result, good))
    else:
        terminal.emit(result.summary.line(mechanism.name))
        _print(options, limit, result, good)
        suggest_next(options, "impulse_ledger" if result.compensator == "none" else result.compensator)
    return 0 if good else 1


def _run_ideal_contact(options: SimulateOptions, mechanism: SixAxisMechanism) -> int:
    """Simulate the ideal contact without a rig, and print its metrics.

    Return the exit code: 1 if the bodies do not touch, else 0.
    """
    from jaxhil.sixdof.ideal_run import simulate_ideal_contact

    result = simulate_ideal_contact(mechanism)
    episode = result.episode
    _write_one_axis_file(options, mechanism, episode)
    if options.json:
        episodes = [episode._asdict()] if episode.reference_touches else []
        final = {"reference_final": result.final._asdict(), "status": result.status}
        verdict = {"verdict": "good" if episode.reference_touches else "bad"}
        document = {"mechanism": mechanism.name, "axes": 6, "episodes": episodes}
        terminal.emit_json("simulate", document | final | verdict)
    else:
        headings = ["m_n [kg]", "approach [mm/s]", "e*", "peak [N]", "peak [N m]", "in touch [ms]", "touches"]
        row = [
            episode.effective_mass,
            1e3 * episode.approach_velocity,
            episode.reference_restitution,
            episode.reference_peak_force,
            episode.reference_peak_moment,
            1e3 * episode.reference_duration,
            episode.reference_touches,
            result.status,
        ]
        table = terminal.build_table(
            f"{mechanism.name}, ideal contact", [*headings, "status"], [row], texts=(7,)
        )
        speed, turning = ([f"{part:.4g}" for part in result.final.twist[at : at + 3]] for at in (0, 3))
        after = f"After {result.final.time:.4g} s: velocity ({', '.join(speed)}) m/s, "
        terminal.emit(table, after + f"angular velocity ({', '.join(turning)}) rad/s of C relative to T.")
    return 0 if episode.reference_touches else 1


def _worst_twist_error(result: "SixAxisRun") -> float:
    """Return the largest twist error of all episodes [1]."""
    return max(episode.twist_error for episode in result.episodes)


def _is_unlike_ideal(result: "SixAxisRun") -> list[bool]:
    """Return for each episode whether its force or duration differs too much from the ideal contact's."""
    from jaxhil.simulation.contact_bounds import is_contact_out_of_bounds

    period = result.mechanism.rig.control_period
    return [
        is_contact_out_of_bounds(
            episode.peak_force,
            episode.reference_peak_force,
            episode.duration,
            episode.reference_duration,
            period,
        )
        for episode in result.episodes
    ]


def _write(options: SimulateOptions, result: "SixAxisRun") -> None:
    """Write the plot, the animation and the log to the files that the options name, if any."""
    title = f"{result.mechanism.name}, compensation: {result.compensator}"
    if options.plot is not None:
        from jaxhil.files import report_write_errors, resolve_output_path
        from jaxhil.simulation.contact_plot import save_figure
        from tuning.plots.six_axes import six_axes_plot

        with report_write_errors(options.plot):
            save_figure(six_axes_plot(result.ticks, title), resolve_output_path(options.plot))
        terminal.note(f"wrote {options.plot}")
    if options.animate is not None:
        from jaxhil.files import report_write_errors, resolve_output_path
        from tuning.plots.animation import animate

        with report_write_errors(options.animate):
            animate(result.ticks, title, resolve_output_path(options.animate))
        terminal.note(f"wrote {options.animate}")
    if options.log is not None:
        result.to_csv(options.log)
        terminal.note(f"wrote {options.log}")


def _write_one_axis_file(options: SimulateOptions, mechanism: SixAxisMechanism, episode: Any) -> None:
    """Write the one-axis file that `--one-axis` requests, if any; note the keys that the file leaves out."""
    if options.one_axis is None:
        return
    from jaxhil.mechanism.template import format_mechanism_file
    from jaxhil.sixdof.one_axis import convert_to_one_axis

    converted = convert_to_one_axis(mechanism, episode)
    text = format_mechanism_file(converted.mechanism)
    checks.write_mechanism_file("--one-axis", Path(options.one_axis), text)
    left_out = f", without {', '.join(converted.left_out)}" if converted.left_out else ""
    terminal.note(f"wrote {options.one_axis}{left_out}")


def _build_document(limit: float, result: "SixAxisRun", good: bool) -> dict[str, Any]:
    return {
        "mechanism": result.mechanism.name,
        "axes": 6,
        "compensator": result.compensator,
        "gains": result.gains,
        "episodes": [episode._asdict() for episode in result.episodes],
        "final": result.final._asdict(),
        "reference_final": result.reference_final._asdict(),
        "status": result.status,
        "meaning": result.summary._asdict(),
        "limit": limit,
        "verdict": "good" if good else "bad",
    }


def _print(options: SimulateOptions, limit: float, result: "SixAxisRun", good: bool) -> None:
    rows = [
        [
            number,
            f"{episode.energy_error:+.4f}",
            f"{episode.twist_error:.4f}",
            episode.restitution,
            episode.reference_restitution,
            episode.peak_force,
            episode.peak_moment,
            1e3 * episode.duration,
            episode.status,
        ]
        for number, episode in enumerate(result.episodes, start=1)
    ]
    headings = [
        "episode", "energy error", "twist error", "e", "e*", "peak [N]", "peak [N m]", "in touch [ms]",
        "status",
    ]  # fmt: skip
    title = f"{result.mechanism.name}, compensation: {result.compensator}"
    rule = "the gain file's gains" if options.gains is not None else "gains by the literature's rule"
    title += f", {rule}" if result.compensator != "none" else ""
    terminal.emit(
        terminal.build_table(title, headings, rows, texts=(len(headings) - 1,)),
        *(_describe_twist_error(number, episode) for number, episode in enumerate(result.episodes, start=1)),
        _verdict(limit, result, good),
    )


def _describe_twist_error(number: int, episode: "Episode") -> str:
    """Return a sentence with the parts of an episode's twist error and the metrics of the ideal contact."""
    parts = f"normal {episode.normal_part:+.3f}, lateral {episode.lateral_part:.3f}"
    parts += f", rotational {episode.rotational_part:.3f}"
    space = f"{terminal.format_number(episode.reference_peak_force)} N, "
    space += f"{terminal.format_number(episode.reference_peak_moment, 3)} N m"
    space += f", {1e3 * episode.reference_duration:.4g} ms"
    touches = f"touches: {episode.touches}, ideal contact {episode.reference_touches}"
    return f"Episode {number}: twist error {parts}; ideal contact {space}; {touches}."


def _verdict(limit: float, result: "SixAxisRun", good: bool) -> str:
    """Return the verdict on a six-axis run and its reason as a sentence."""
    from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS_SHORT_TEXT, CONTACT_BOUNDS_TEXT

    if result.status == "miss":
        return "Bad: the bodies did not touch."
    if result.status not in GOOD_STATUSES:
        return f"Bad: the run ended with status '{result.status}'."
    if good:
        return f"Good: every twist error is within {limit:g}, {CONTACT_BOUNDS_TEXT}."
    if _worst_twist_error(result) <= limit:
        number = _is_unlike_ideal(result).index(True)
        episode = result.episodes[number]
        force, time = (
            episode.peak_force / episode.reference_peak_force,
            episode.duration / episode.reference_duration,
        )
        reason = f"real peak force {force:.3g} times, contact time {time:.3g} times the ideal contact's"
        return f"Bad: episode {number + 1}: {reason}, expected {CONTACT_BOUNDS_SHORT_TEXT}."
    return f"Bad: the largest twist error is {_worst_twist_error(result):.4f}, limit {limit:g}."
