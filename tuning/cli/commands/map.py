"""Command `jaxhil map`: computes the error of a contact as a function of two keys of a mechanism."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from jaxhil.errors import to_one_line
from jaxhil.simulation.jax_environment import prepare_jax
from tuning import terminal
from tuning.api import mechanism_summary
from tuning.api.map import DOCUMENT_FILE, PLOT, MapOptions, map
from tuning.api.options import check_options
from tuning.cli.commands import checks
from tuning.cli.commands.choice import (
    load_any_named_mechanism,
    select_any_compensator,
    suggest_next,
)
from tuning.cli.options_report import Map
from tuning.plots.stability_map import describe_missing_error


def run(options: Map) -> int:
    """Compute a stability map, and write and print it; return exit code 0."""
    check_options(options)
    mechanism = load_any_named_mechanism(options)
    target = Path(options.output)
    checks.prepare_output_folder(target)
    prepare_jax()
    mechanism, compensator, gains = select_any_compensator(options, mechanism)
    checks.check_earlier_results(target / DOCUMENT_FILE, "theory", [PLOT], [mechanism.name])
    settings = {field.name: getattr(options, field.name) for field in fields(MapOptions)}
    stability_map = map(
        mechanism, options.x, options.y, compensator, gains, folder=target, progress=True, **settings
    )
    mechanism_summary.report_summary(mechanism, None if options.json else terminal.emit)
    if options.json:
        terminal.emit_json("map", stability_map.document)
    else:
        terminal.emit(*_describe_map(stability_map.document))
        terminal.emit_line(f"Wrote {to_one_line(str(target / DOCUMENT_FILE))} and {PLOT}")
        is_untunable = compensator == "none" and stability_map.document["axes"] == 6
        suggest_next(options, "phase_lead" if is_untunable else compensator)
    return 0


def _describe_map(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences: nominal error, margins, spectral radius, and the reason if no closed form applies."""
    nominal, limit = document["nominal"], document["limit"]
    error = nominal["error"]
    if error is None:
        yield f"Nominal: {describe_missing_error(document['axes'])}."
    else:
        kind = "divergence" if error > 0 else "convergence"
        text = f"error {error:+.4f} ({kind})" if document["axes"] == 1 else f"twist error {error:.4f}"
        yield f"Nominal: largest {text}, {'within' if abs(error) <= limit else 'beyond'} {limit:g}."
        within = "beyond" if nominal["margins"]["contact"] is None else "within"
        yield (
            f"Nominal: real peak force {nominal['peak_force_ratio']:.3f} times, duration "
            f"{nominal['duration_ratio']:.3f} times the ideal contact's, {within} "
            f"{_describe_bounds(document)}."
        )
    if (margins := nominal["margins"]["error"]) is not None:
        yield from (f"{text}, within {limit:g}." for text in _describe_margins(document, margins))
    if (margins := nominal["margins"]["contact"]) is not None:
        yield from (
            f"{text}, within {_describe_bounds(document)}." for text in _describe_margins(document, margins)
        )
    growth = nominal["growth"]
    if growth is None:
        yield f"No spectral radius: {document['spectral_radius']['none_because']}."
    else:
        radius, rate = growth["spectral_radius"], growth["per_second"]
        rate_text = f"{'grows' if rate > 0 else 'decays'} by {abs(rate):.4g} per second"
        rate_text += f" at {growth['frequency']:.3g} Hz"
        half = growth["per_half_oscillation"]
        factor = "" if half is None else f", by the factor {half:.4f} over half an oscillation"
        yield f"A contact that lasts {rate_text}{factor} (spectral radius {radius:.6f} a control period)."
        if growth["by_gain"]:
            slopes = ", ".join(f"{name} {slope:+.3g}" for name, slope in growth["by_gain"].items())
            yield f"Derivative of the spectral radius with respect to gains, in SI units: {slopes}."
        if (margins := nominal["margins"]["spectral_radius"]) is not None:
            yield from (
                f"{text}, with a spectral radius of at most 1."
                for text in _describe_margins(document, margins)
            )
    reason = document["theory"]["none_because"]
    if reason not in (None, document["spectral_radius"]["none_because"]):
        yield f"No closed form applies: {reason}."


def _describe_bounds(document: Mapping[str, Any]) -> str:
    force, *duration = document["bounds"].values()
    return f"{force:g} times the peak force and {duration[0]:g} to {duration[1]:g} times the duration"


def _describe_margins(document: Mapping[str, Any], margins: Mapping[str, Any]) -> Iterator[str]:
    """Yield, for each of the map's two keys, a text with the range between its lower and upper margin."""
    for axis in "xy":
        margin, values = margins[axis], document[axis]["values"]
        ends = [
            f"{terminal.format_number(values[index])} (the map's end)"
            if margin[end] is None
            else terminal.format_number(margin[end])
            for end, index in (("low", 0), ("high", len(values) - 1))
        ]
        yield f"{document[axis]['key']}: from {ends[0]} to {ends[1]} {document[axis]['unit']}"
