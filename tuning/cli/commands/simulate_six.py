"""`jaxhil simulate` on a mechanism of six axes."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxhil.errors import InputError, shown
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import Simulate

if TYPE_CHECKING:
    from jaxhil.sixdof.run import Episode, SixAxisRun

FILMS = (".gif", ".mp4")
GOOD = ("rebounded", "captured")  # how a run may end


def check(options: Simulate) -> None:
    """What six axes do not have yet is not asked for. Raises `InputError`."""
    if options.setting is not None:
        found = f"--setting: found {shown(options.setting)}"
        raise InputError(f"{found}, allowed none: in six axes there is none so far")
    if options.reference:
        for key in ("compensator", "gains", "plot", "animate", "log"):
            value = getattr(options, key)
            if value is not None:
                raise InputError(f"--{key}: found {shown(str(value))}, allowed none beside --reference")
    if options.animate is not None:
        _check_film(options.animate)


def _check_film(path: str) -> None:
    suffix = Path(path).suffix.lower()
    if suffix not in FILMS:
        raise InputError(f"--animate: found {shown(path)}, allowed a name that ends in {', '.join(FILMS)}")
    if suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError(
            f"--animate: found {shown(path)}, allowed .gif: there is no ffmpeg, which makes .mp4"
        )
    checks.file(path)


def run(options: Simulate, mechanism: SixAxisMechanism) -> int:
    """Run the episodes, report each; 0 if both errors of each are within the limit, else 1."""
    if options.reference:
        return _run_in_space(options, mechanism)
    from jaxhil.sixdof.run import simulate_six_axes

    gains = None if options.gains is None else Path(options.gains)
    done = simulate_six_axes(mechanism, options.compensator or "none", gains, seed=options.seed)
    good = done.status in GOOD and all(_worst(episode) <= options.limit for episode in done.episodes)
    good = good and not any(_unlike(done))
    terminal.warn(f"{mechanism.name}: {warning}" for warning in done.meaning.warnings)
    _write(options, done)
    if options.json:
        terminal.emit_json(_document(options, done, good))
    else:
        terminal.emit_line(done.meaning.line(mechanism.name))
        _print(options, done, good)
    return 0 if good else 1


def _run_in_space(options: Simulate, mechanism: SixAxisMechanism) -> int:
    """Follow the bodies without a rig, and report them; 0 if something touches, else 1."""
    from jaxhil.sixdof.alone import simulate_in_space

    done = simulate_in_space(mechanism)
    episode = done.episode
    if options.json:
        episodes = [episode._asdict()] if episode.reference_touches else []
        document = {"mechanism": mechanism.name, "axes": 6, "episodes": episodes}
        terminal.emit_json(document | {"reference_final": done.final._asdict(), "status": done.status})
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
            done.status,
        ]
        table = terminal.table(f"{mechanism.name}, in space", [*headings, "status"], [row], texts=(7,))
        speed, turning = ([f"{part:.4g}" for part in done.final.twist[at : at + 3]] for at in (0, 3))
        after = f"After {done.final.time:.4g} s: velocity ({', '.join(speed)}) m/s, "
        terminal.emit(table, after + f"angular velocity ({', '.join(turning)}) rad/s of C against T.")
    return 0 if episode.reference_touches else 1


def _worst(episode: "Episode") -> float:
    return max(abs(episode.energy_error), episode.twist_error)


def _unlike(done: "SixAxisRun") -> list[bool]:
    """Return of every episode whether its real contact is unlike the ideal one."""
    from jaxhil.simulation.contact_bounds import unlike_ideal

    period = done.mechanism.rig.control_period
    return [
        unlike_ideal(one.peak_force, one.reference_peak_force, one.duration, one.reference_duration, period)
        for one in done.episodes
    ]


def _write(options: Simulate, done: "SixAxisRun") -> None:
    title = f"{done.mechanism.name}, compensation: {done.compensator}"
    if options.plot is not None:
        from jaxhil.files import follow, writing
        from jaxhil.simulation.contact_plot import save
        from tuning.pictures.six_axes import six_axes_plot

        with writing(options.plot):
            save(six_axes_plot(done.ticks, title), follow(options.plot))
        terminal.note(f"wrote {options.plot}")
    if options.animate is not None:
        from jaxhil.files import follow, writing
        from tuning.pictures.animation import animate

        with writing(options.animate):
            animate(done.ticks, title, follow(options.animate))
        terminal.note(f"wrote {options.animate}")
    if options.log is not None:
        done.to_csv(options.log)
        terminal.note(f"wrote {options.log}")


def _document(options: Simulate, done: "SixAxisRun", good: bool) -> dict[str, Any]:
    return {
        "mechanism": done.mechanism.name,
        "axes": 6,
        "compensator": done.compensator,
        "gains": done.gains,
        "episodes": [episode._asdict() for episode in done.episodes],
        "final": done.final._asdict(),
        "reference_final": done.reference_final._asdict(),
        "status": done.status,
        "meaning": done.meaning._asdict(),
        "limit": options.limit,
        "verdict": "good" if good else "bad",
    }


def _print(options: Simulate, done: "SixAxisRun", good: bool) -> None:
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
        for number, episode in enumerate(done.episodes, start=1)
    ]
    headings = [
        "episode", "energy error", "twist error", "e", "e*", "peak [N]", "peak [N m]", "in touch [ms]",
        "status",
    ]  # fmt: skip
    title = f"{done.mechanism.name}, compensation: {done.compensator}"
    rule = "the gain file's gains" if options.gains is not None else "gains by the literature's rule"
    title += f", {rule}" if done.compensator != "none" else ""
    terminal.emit(
        terminal.table(title, headings, rows, texts=(len(headings) - 1,)),
        *(_more(number, episode) for number, episode in enumerate(done.episodes, start=1)),
        _verdict(options, done, good),
    )


def _more(number: int, episode: "Episode") -> str:
    parts = f"normal {episode.normal_part:+.3f}, lateral {episode.lateral_part:.3f}"
    parts += f", rotational {episode.rotational_part:.3f}"
    space = f"{episode.reference_peak_force:.4g} N, {episode.reference_peak_moment:.3g} N m"
    space += f", {1e3 * episode.reference_duration:.4g} ms"
    touches = f"touches: {episode.touches}, in space {episode.reference_touches}"
    return f"Episode {number}: twist error {parts}; in space {space}; {touches}."


def _verdict(options: Simulate, done: "SixAxisRun", good: bool) -> str:
    from jaxhil.simulation.contact_bounds import BRIEFLY, STATED

    if done.status == "miss":
        return "Bad: nothing touched."
    if done.status not in GOOD:
        return f"Bad: the run ended with status '{done.status}'."
    if good:
        return f"Good: every energy and twist error is within {options.limit:g}, {STATED}."
    if all(_worst(episode) <= options.limit for episode in done.episodes):
        number = _unlike(done).index(True)
        one = done.episodes[number]
        force, time = one.peak_force / one.reference_peak_force, one.duration / one.reference_duration
        what = f"real peak force {force:.3g} times, time in touch {time:.3g} times the ideal contact's"
        return f"Bad: episode {number + 1}: {what}, allowed {BRIEFLY}."
    worst = max(done.episodes, key=_worst)
    errors = f"{worst.energy_error:+.4f} and {worst.twist_error:.4f}"
    return f"Bad: the largest energy and twist errors are {errors}, allowed {options.limit:g}."
