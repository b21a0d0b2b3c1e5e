"""Plots of a report as SVG elements in the page.

SVG elements are visible without JavaScript and on paper; a plotting script would increase the page by more
than 3 MB. In the plot of a sweep, the point of a scenario is a link to the plot of the scenario's run.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.contact_plot import plot_contacts
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.motion_curves import compute_nominal_motion
from jaxhil.sixdof.run import simulate_six_axes
from tuning.identification.monitor.metrics import METRICS
from tuning.plots.identification import plot_estimates
from tuning.plots.monitor import monitor_plot
from tuning.plots.one_contact import describe_contact, plot_one_contact
from tuning.plots.parts import as_svg
from tuning.plots.scenarios import linked_scenarios
from tuning.plots.six_axes import six_axes_plot
from tuning.plots.stability_map import map_plot
from tuning.reporting.documents import (
    AxisOfMap,
    IdentificationDocument,
    MapDocument,
    MonitoringDocument,
    WorstScenario,
)
from tuning.stability_map.axes import MapAxis
from tuning.stability_map.closed_forms import ClosedForms
from tuning.stability_map.contact_growth import Growth
from tuning.stability_map.grid import MapResults, NominalMargin, NominalPoint, SpectralRadii
from tuning.sweeps.chunks import build_sweep
from tuning.sweeps.plot_statistics import PlotPoints, read_regions
from tuning.sweeps.replay import compute_motion
from tuning.sweeps.store import SweepStore

# Number of scenarios that are plotted in addition to the worst; their ranks in the order of errors are evenly
# spaced.
TYPICAL_SCENARIOS = 6
ESTIMATE_FIELDS = ("key", "value", "unit", "std", "low", "high", "prior")  # fields that the plot needs


class SvgPlot(NamedTuple):
    """Plot as an SVG element, with a caption and a description for screen readers."""

    svg: str
    says: str  # description for screen readers
    caption: str


class ScenarioPlot(NamedTuple):
    """Plot of the run of one scenario of a sweep."""

    index: int  # index of the scenario
    text: str  # description of the scenario's outcome
    drawing: SvgPlot


def draw_nominal_run(subject: LoadedGains) -> tuple[SvgPlot | None, SvgPlot]:
    """Plot the first nominal contact (None if its e is undefined), and the complete nominal run."""
    if isinstance(subject.mechanism, SixAxisMechanism):
        return None, _draw_six_axis_run(subject)
    law = subject.compensator
    laws = {"before": ("none", {}), "literature": (law, literature_gains(subject.mechanism, law))}
    if law == "none":
        laws = {}
    motion = compute_nominal_motion(subject.mechanism, {**laws, "tuned": (law, subject.gains)})
    figure = plot_contacts(motion, f"{subject.mechanism.name}, nominal run: {law}", sensors="tuned")
    run = SvgPlot(as_svg(figure), "Force and position over time of every contact", "The nominal run.")
    if (result := describe_contact(motion[0])) is None:
        return None, run
    contact = as_svg(plot_one_contact(motion[0], subject.mechanism.name))
    return SvgPlot(contact, result, "Position of the numerical model in the first nominal contact."), run


def _draw_six_axis_run(subject: LoadedGains) -> SvgPlot:
    """Plot the nominal run of a six-axis mechanism with the gains `subject`."""
    run = simulate_six_axes(subject.mechanism, subject.compensator, subject.gains)
    figure = six_axes_plot(run.ticks, f"{subject.mechanism.name}, nominal run: {subject.compensator}")
    says = "Pose, forces and moment over time, compared with the ideal contact"
    [episode, *_] = run.episodes
    errors = f"Energy error {episode.energy_error:+.4f}, twist error {episode.twist_error:.4f}"
    return SvgPlot(as_svg(figure), says, f"The nominal run. {errors}.")


def draw_map(document: MapDocument) -> SvgPlot:
    """Plot a stability map from its JSON document."""
    title = f"{document.mechanism}, compensation: {document.compensator}"
    figure = map_plot(
        _map_from_document(document), title, np.inf if document.limit is None else document.limit
    )
    says = f"Restitution error over {document.x.key} and {document.y.key}"
    return SvgPlot(as_svg(figure), says, f"{says}; the gains are the same at every point.")


def draw_estimates(document: IdentificationDocument) -> SvgPlot:
    """Plot the identified parameters and their prior values."""
    estimates = [estimate for estimate in document.estimates if None not in (estimate.low, estimate.high)]
    entries = [{name: getattr(estimate, name) for name in ESTIMATE_FIELDS} for estimate in estimates]
    says = "95 % interval of each estimate, and the prior's value, relative to the estimate"
    return SvgPlot(as_svg(plot_estimates(entries)), says, f"{says}.")


def monitor_drawing(document: MonitoringDocument) -> SvgPlot:
    """Plot the metrics in a monitoring document against the number of the contact."""
    numbers = [contact.contact for contact in document.contacts]
    metrics = {name: _columns(document, name) for name, *_ in METRICS}
    figure = monitor_plot(document.mechanism, numbers, metrics, document.since)
    says = "Metrics of every contact over its number, with their predicted range"
    return SvgPlot(as_svg(figure), says, f"{says}: 95 % of the contacts if the mechanism file is correct.")


def _columns(document: MonitoringDocument, name: str) -> np.ndarray:
    """Return values, predicted standard deviations and normalised deviations z of a metric, (3, contacts)."""
    rows = []
    for contact in document.contacts:
        metric = contact.figures.get(name)
        rows.append((None,) * 3 if metric is None else (metric.value, metric.predicted_std, metric.z))
    return np.array(rows, float).reshape(-1, 3).T


def draw_sweep(
    store: SweepStore, worst: Sequence[WorstScenario], say: Callable[[str], None]
) -> tuple[SvgPlot, list[ScenarioPlot]]:
    """Plot the errors of a sweep's scenarios as points, and the runs of the worst and typical scenarios.

    `say` is called with the name of each run. Return the plot of the errors, and the plots of the runs.
    """
    sweep = build_sweep(store.manifest)
    plan, regions = read_regions(store, sweep.mechanism)
    assert plan is not None and regions is not None
    points = regions.points
    texts = {
        entry.index: _describe_end(entry.outcome, entry.worst_error, entry.worst_contact) for entry in worst
    }
    for position in _select_typical(points):
        texts.setdefault(int(points.index[position]), f"|e - e*| at most {points.size[position]:.4g}")
    name = sweep.mechanism.name
    figure = linked_scenarios(name, plan.per_scenario, points, store.manifest.limit, list(texts))
    caption = "Scenarios of the sweep. A point with a ring is a link to the plot of its run below."
    drawing = SvgPlot(as_svg(figure, texts), "Worst error of scenarios over the drawn inputs", caption)
    traces = []
    for index, text in texts.items():
        say(f"scenario {index}")
        run_figure = plot_contacts(compute_motion(sweep, index), f"{name}, scenario {index}", sensors="rig")
        run_drawing = SvgPlot(
            as_svg(run_figure), f"Force and position over time of scenario {index}", f"{text}."
        )
        traces.append(ScenarioPlot(index, text, run_drawing))
    return drawing, traces


def _select_typical(points: PlotPoints) -> list[int]:
    """Return indices into `points` of scenarios whose ranks in the order of errors are evenly spaced.

    The scenario with the smallest error is included; the scenario with the largest error is not.
    """
    order = np.argsort(points.size, kind="stable")
    order = order[np.isfinite(points.size[order])]
    ranks = (
        np.linspace(0, len(order) - 1, TYPICAL_SCENARIOS + 1)[:-1].round().astype(int) if len(order) else []
    )
    return [int(order[rank]) for rank in dict.fromkeys(ranks)]


def _describe_end(outcome: str, error: float | None, contact: int | None) -> str:
    """Return a text with the outcome and the worst error of a scenario."""
    if error is None:
        return outcome
    return f"{outcome}, e - e* = {error:+.4f}" + ("" if contact is None else f" in contact {contact}")


def _map_from_document(document: MapDocument) -> MapResults:
    """Convert the JSON document of a stability map to the results from which the map is drawn."""

    def table(values: Any) -> Any:
        return None if values is None else np.array(values, float)

    def axis(entry: AxisOfMap) -> MapAxis:
        return MapAxis(entry.key, "", (), entry.unit, entry.nominal, entry.values[0], entry.values[-1])

    theory, radius, nominal = document.theory, document.spectral_radius, document.nominal
    closed = ClosedForms(
        table(theory.series), table(theory.characteristic_root), table(theory.delay_over_critical),
        theory.none_because,
    )  # fmt: skip
    radii = (
        None
        if radius.values is None
        else SpectralRadii(table(radius.x), table(radius.y), table(radius.values))
    )
    margins = [
        None if margin is None else tuple(NominalMargin(margin[axis].low, margin[axis].high) for axis in "xy")
        for margin in (nominal.margins.error, nominal.margins.contact, nominal.margins.spectral_radius)
    ]
    growth = None
    if (nominal_growth := nominal.growth) is not None:
        half = nominal_growth.per_half_oscillation
        growth = Growth(
            nominal_growth.spectral_radius,
            nominal_growth.per_second,
            half,
            nominal_growth.frequency,
            nominal_growth.by_gain,
        )
    ratios = nominal.peak_force_ratio, nominal.duration_ratio
    point = NominalPoint(nominal.restitution, nominal.error, *ratios, growth, *margins)  # pyright: ignore[reportArgumentType]
    return MapResults(
        axes=(axis(document.x), axis(document.y)),
        x=table(document.x.values),
        y=table(document.y.values),
        restitution=table(document.restitution),
        error=table(document.error),
        peak_force_ratio=table(document.peak_force_ratio),
        duration_ratio=table(document.duration_ratio),
        closed=closed,
        radii=radii,
        no_growth=radius.none_because,
        nominal=point,
        rig_axes=document.axes,
    )
