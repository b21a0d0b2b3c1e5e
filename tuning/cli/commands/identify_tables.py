"""JSON document and printed tables of the command `jaxhil identify`."""

import math
from pathlib import Path
from typing import Any

from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import digest
from jaxhil.simulation.source_fingerprint import dependency_versions
from tuning import terminal
from tuning.cli.options_identify import IdentifyOptions
from tuning.identification.records import Campaign

SCHEMA = "jaxhil/identification/1"
MECHANISM_FILE, DOCUMENT_FILE = "mechanism.toml", "identification.json"


def build_document(
    options: IdentifyOptions, campaign: Campaign, prior: Mechanism | None, result
) -> dict[str, Any]:
    """Return the JSON document of an identification, or of a check against the mechanism `prior`."""
    kinds = [run.kind for run in campaign.runs]
    clock = campaign.timing.clock
    content = {
        "schema": SCHEMA,
        "estimates": [build_estimate_entry(estimate, prior) for estimate in result.estimates],
        "combinations": [build_estimate_entry(estimate, None) for estimate in result.combinations],
        "confounded": [
            dict(zip(("one", "other", "correlation", "experiment"), pair, strict=True))
            for pair in result.confounded
        ],
        "checks": [
            {
                **{name: getattr(line, name) for name in ("name", "finding", "where")},
                "there": bool(line.is_significant),
                "counts": line.is_in_verdict,
                "effect": float(line.effect),
                "effect_on_error": float(line.effect if line.on_error is None else line.on_error),
            }
            for line in result.lines
        ],
        "effect": result.effect,
        "effect_on_error": result.effect_on_error,
        "limit": result.limit,
        "verdict": "good" if result.good else "bad",
        "reason": result.verdict,
        "notes": [*campaign.notes, *result.notes],
        "runs": {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)},
        "clock": None if clock is None else {**vars(clock)},
        "sources": campaign.sources,
        "mechanism": result.mechanism,
        "seed": options.seed,
        "versions": dependency_versions(),
    }
    plain = terminal.to_json_data(content)
    return {**plain, "sha256": digest(plain)}


def print_estimates(document: dict[str, Any], folder: Path | None) -> None:
    """Print the estimates and checks of a document; `folder` is the folder of the written files."""
    runs = ", ".join(f"{number} {kind}" for kind, number in document["runs"].items())
    rows = [_estimate_row(entry) for entry in (*document["estimates"], *document["combinations"])]
    headings = ["number", "estimate", "95 % from", "to", "unit", "prior", "change [%]"]
    items: list[Any] = [terminal.build_table(f"Identified from runs: {runs}", headings, rows, texts=(0, 4))]
    items.append(build_check_table(document, "What the model does not explain"))
    items += [
        f"The estimates of {terminal.format_key(pair['one'])} and {terminal.format_key(pair['other'])} are "
        f"strongly correlated ({pair['correlation']:.3f}): {pair['experiment']} would separate them."
        for pair in document["confounded"]
    ]
    wrote = (
        []
        if folder is None
        else [f"Wrote {folder / MECHANISM_FILE}, {folder / DOCUMENT_FILE} and plots beside them"]
    )
    terminal.emit(*items, f"{document['reason']}.", *wrote)


def build_check_table(document: dict[str, Any], title: str) -> Any:
    """Return the table of the model's checks; each row shows a finding and its effect on e and on e - e*."""
    rows = []
    for check in document["checks"]:
        finding = ", ".join(filter(None, (check["finding"], check["where"])))
        effects = [
            terminal.format_number(check[name] * check["there"], 2) if check["counts"] else "-"
            for name in ("effect", "effect_on_error")
        ]
        rows.append([check["name"], finding, *effects])
    return terminal.build_table(title, ["check", "found", "effect on e", "on e-e*"], rows, (0, 1))


def build_estimate_entry(estimate, prior: Mechanism | None) -> dict[str, Any]:
    """Return the JSON entry of an estimate, with its change from the prior.

    The entry `change` is relative to the prior, and `deviation` is in standard deviations of the estimate.
    """
    expected = _prior_value(prior, estimate.key)
    return {
        "key": estimate.key,
        "value": estimate.value,
        "std": estimate.std,
        "low": estimate.low,
        "high": estimate.high,
        "unit": estimate.unit,
        "known": estimate.is_fixed,
        "prior": expected,
        "change": (estimate.value - expected) / abs(expected) if expected else None,
        "deviation": None
        if expected is None or not estimate.std
        else (estimate.value - expected) / estimate.std,
    }


def _prior_value(prior: Mechanism | None, key: str) -> float | None:
    """Return the prior's value of a key, or None; an index beyond a list selects the list's last entry."""
    if prior is None:
        return None
    path, _, index = key.rpartition(".")
    try:
        value = value_at(prior, path if index.isdigit() else key)
    except AttributeError:
        return None
    if isinstance(value, list):
        value = value[min(int(index or 0), len(value) - 1)] if value and index.isdigit() else None
    return float(value) if isinstance(value, (int, float)) else None


def _estimate_row(entry: dict[str, Any]) -> list[Any]:
    """Return the table row of an estimate; the uncertainty determines the number of digits."""
    digits = 4
    if entry["std"] and entry["value"]:
        digits = min(max(1 + math.ceil(math.log10(abs(entry["value"]) / entry["std"])), 2), 6)
    change = entry["change"]
    return [
        terminal.format_key(entry["key"]),
        *(terminal.format_number(float(entry[name]), digits) for name in ("value", "low", "high")),
        entry["unit"],
        entry["prior"],
        "-" if change is None else f"{round(100.0 * change, 4):+.2g}",
    ]
