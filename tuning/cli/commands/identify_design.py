"""Command `jaxhil identify --design`: designs rig commands that best identify a mechanism."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhil.errors import InputError, to_one_line
from jaxhil.files import report_write_errors, write_atomically
from jaxhil.mechanism.file import load
from jaxhil.rig import digest
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.simulation.source_fingerprint import dependency_versions
from tuning import terminal
from tuning.api import arguments
from tuning.cli.commands import checks
from tuning.cli.options_identify import IdentifyOptions

if TYPE_CHECKING:
    from tuning.identification.design.excitation import Excitation, ExcitationDesign

SCHEMA = "jaxhil/design/1"
DOCUMENT_FILE = "design.json"
COMPENSATOR = "response_error"


def run(options: IdentifyOptions) -> int:
    """Write the commands for a run without contact and a run that presses the mechanism against the surface.

    Also write the predicted uncertainty of the estimates. Return exit code 0.
    """
    mechanisms = [*options.logs, *([options.prior] if options.prior is not None else [])]
    if len(mechanisms) != 1:
        raise InputError(
            f"--design: found {len(mechanisms)} mechanisms, expected one file with approximate values"
        )
    if not 0.0 < options.stroke <= 1.0:
        raise InputError(f"--stroke: found {options.stroke:g} m, expected a number > 0 and <= 1 m")
    arguments.check_integers(0, seed=options.seed)
    mechanism = load(mechanisms[0]).mechanism
    folder = Path(options.output)
    checks.prepare_output_folder(folder)
    checks.check_earlier_results(folder / DOCUMENT_FILE, "predicted", ("free.csv", "press.csv"))
    with jax_context(), terminal.show_stages(1) as stages:
        from jaxhil.simulation.gain_choice import choose_gains
        from tuning.identification.design.excitation import design_excitation, differentiate_error

        stages.turn_to("optimising the rig commands")
        gains = choose_gains(mechanism, COMPENSATOR, None)[1]
        slopes_by = partial(differentiate_error, mechanism, COMPENSATOR, gains)
        result = design_excitation(mechanism, options.stroke, slopes_by, options.seed)
    sensors = mechanism.rig.position_sensor, mechanism.rig.force_sensor
    if not all(sensor.noise_std or sensor.quantum for sensor in sensors):
        terminal.warn(["for a sensor without noise in the mechanism file, 5 um or 0.5 N is assumed"])
    document = _build_document(options, mechanism.name, result)
    period = mechanism.rig.control_period
    for name, excitation in (("free", result.free), ("press", result.press)):
        _write(folder / f"{name}.csv", excitation, period)
    with report_write_errors(folder / DOCUMENT_FILE):
        write_atomically(folder / DOCUMENT_FILE, terminal.format_json(document).encode("ascii"))
    if options.json:
        terminal.emit_json("identify", document)
    else:
        _print(document, folder)
    return 0


def _write(path: Path, excitation: Excitation, period: float) -> None:
    """Write an excitation to a CSV file with the columns time [s] and position_desired [m]."""
    rows = [f"{period * n:.9g},{x:.9g}\n" for n, x in enumerate(excitation.position.tolist())]
    with report_write_errors(path):
        write_atomically(path, "".join(["time,position_desired\n", *rows]).encode("ascii"))


def _build_document(options: IdentifyOptions, name: str, design: ExcitationDesign) -> dict[str, Any]:
    from tuning.identification.estimates import get_unit

    effects = np.sqrt(np.mean(design.slopes**2, axis=0)) * design.std
    numbers = zip(design.keys, design.values, design.std, effects, strict=True)
    content = {
        "schema": SCHEMA,
        "verdict": "good",  # a design has no requirement that could be violated
        "mechanism": to_one_line(name),
        "predicted": [
            {"key": key, "value": value, "std": std, "effect": effect, "unit": get_unit(key)}
            for key, value, std, effect in numbers
        ],
        "error": design.error,
        "flat": design.flat,
        "runs": {
            kind: {
                "crest_factor": excitation.crest,
                "rms": float(np.sqrt(0.5 * np.sum(excitation.amplitude**2))),
                "rows": len(excitation.position),
                "lines": [
                    [f, a]
                    for f, a in zip(excitation.frequency.tolist(), excitation.amplitude.tolist(), strict=True)
                ],
            }
            for kind, excitation in (("free", design.free), ("press", design.press))
        },
        "stroke": options.stroke,
        "seed": options.seed,
        "versions": dependency_versions(),
    }
    plain = terminal.to_json_data(content)
    return {**plain, "sha256": digest(plain)}


def _print(document: dict[str, Any], folder: Path) -> None:
    rows = [
        [terminal.format_key(entry["key"]), *(entry[name] for name in ("value", "std", "unit", "effect"))]
        for entry in document["predicted"]
    ]
    headings = ["number", "value", "std", "unit", "effect on e"]
    items: list[Any] = [terminal.build_table("Predicted uncertainty after both runs", headings, rows, (0, 3))]
    runs = document["runs"]
    items.append(
        f"The predicted uncertainty of e is {document['error']:.2g}; with flat spectra within the same "
        f"limits it would be {document['flat']:.2g} times as large. The crest factors are "
        f"{runs['free']['crest_factor']:.2f} and {runs['press']['crest_factor']:.2f}."
    )
    files = ", ".join(str(folder / name) for name in ("free.csv", "press.csv"))
    items.append(f"Wrote {files} and {folder / DOCUMENT_FILE}")
    terminal.emit(*items)
    terminal.suggest("identify", "--guess", "LOGS")
