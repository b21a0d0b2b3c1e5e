"""What `jaxhil sweep` prints of its document."""

from typing import Any

from jaxhil.errors import one_line
from tuning import terminal


def emit(document: dict[str, Any]) -> None:
    """Tables and the verdict, on standard output."""
    terminal.emit(*_tables(document), *_lines(document))


def _tables(document: dict[str, Any]) -> list[Any]:
    number = document["scenarios"]
    title = f"{document['mechanism']}, compensation: {document['compensator']}, {number} scenarios"
    outcomes = terminal.table(
        f"{title} ({document['sampling']}, {document['precision']})",
        ["outcome", "scenarios", "share"],
        [(name, count, count / number) for name, count in document["outcomes"].items()],
    )
    # All inputs beside each other would not fit; `replay` and the store have them.
    worst = terminal.table(
        "Worst scenarios",
        ["index", "outcome", "error", "episode" if document["axes"] == 6 else "contact"],
        [
            (
                one["index"],
                one["outcome"],
                terminal.signed(one["worst_error"]),
                terminal.figure(one["worst_contact"]),
            )
            for one in document["worst"]
        ],
        texts=(1,),
    )
    symbol = "|error|" if document["axes"] == 6 else "|e - e*|"
    tables = [outcomes, _quantiles(document, symbol), worst]
    if "drivers" in document:
        tables.append(_drivers(document["drivers"], symbol))
    if "rare" in document:
        tables.append(_rare(document["rare"]))
    return tables


def _lines(document: dict[str, Any]) -> list[str]:
    from jaxhil.simulation.contact_bounds import BRIEFLY
    from jaxhil.simulation.metrics import STATUS_REASONS
    from tuning.sweeps.columns import UNLIKE, UNLIKENESS

    probability, number, limit = (document[key] for key in ("failure_probability", "scenarios", "limit"))
    within = "nothing" if limit is None else f"{limit:g}"
    lines = [
        f"Failure probability {probability['value']:.4g}, 95 % interval {probability['low']:.3g} to "
        f"{probability['high']:.3g} ({probability['method']}); {document['failed']} of {number} failed, "
        f"{'energy and twist' if document['axes'] == 6 else 'restitution'} error allowed {within}, "
        f"real contact: {BRIEFLY}."
    ]
    lines += _sequential(document)
    if UNLIKE in document["outcomes"]:
        lines.append(f"{UNLIKE}: {UNLIKENESS}.")
    lines += [f"{name}: {STATUS_REASONS[name]}." for name in document["outcomes"] if name in STATUS_REASONS]
    if left_out := document["left_out_of_replicates"]:
        lines.append(
            f"The last {left_out} scenarios, in no whole replicate, are in neither probability nor quantiles."
        )
    if document.get("rare", {}).get("spread_beyond_formula"):
        lines.append(
            "The replicates of the subset simulation differ far more than its formula explains: some have "
            "missed failures, and the interval may too."
        )
    if (compared := document.get("float32")) is not None:
        lines.append(
            f"float32 beside float64 on {compared['scenarios']} scenarios: errors differ by at most "
            f"{terminal.figure(compared['largest_difference'], 2)}, {compared['changed_outcomes']} outcomes "
            f"changed, {compared['failed_float32']} and {compared['failed_float64']} failed."
        )
    if document["scenarios_per_second"]:
        lines.append(f"{document['scenarios_per_second']:.0f} scenarios per second.")
    acceptable = document["acceptable"]
    wanted = "no scenario may fail" if acceptable is None else f"acceptable up to {acceptable:g}"
    lines.append(f"{document['verdict'].capitalize()}: {wanted}. Wrote {one_line(document['store'])}")
    lines += [f"Wrote {one_line(path)}" for path in document["plots"]]
    return lines


def _quantiles(document: dict[str, Any], symbol: str):
    return terminal.table(
        f"Worst {symbol} of a scenario",
        ["share of scenarios", "|error| up to", "95 % from", "to"],
        [
            (
                f"{100 * one['order']:g} %",
                _size(one["value"]),
                _size(one["low"]),
                _size(one["high"], "no bound"),
            )
            for one in document["error_quantiles"]
        ],
    )


def _drivers(drivers: dict[str, Any], symbol: str):
    return terminal.table(
        f"What drives the worst {symbol}, errors cut at {drivers['cap']:g} ({drivers['capped']} of "
        f"{drivers['evaluations']} runs): shares of the variance",
        ["input", "first order", "95 % from", "to", "total", "95 % from", "to"],
        [
            (one.input, *("-" if number != number else f"{number:.3f}" for number in one[1:]))
            for one in drivers["inputs"]
        ],
    )


def _rare(rare: dict[str, Any]):
    return terminal.table(
        "Subset simulation",
        [
            "|error| beyond",
            "probability",
            "95 % from",
            "to",
            "coefficient of variation",
            "by formula",
            "scenarios",
        ],
        [
            (
                f"{rare['limit']:g}",
                *(f"{rare[key]:.3g}" for key in ("probability", "low", "high")),
                *(_share(rare[f"{key}coefficient_of_variation"]) for key in ("", "formula_")),
                rare["evaluations"],
            )
        ],
    )


def _sequential(document: dict[str, Any]) -> list[str]:
    width = document["until_width"]
    if width is None:
        return []
    probability, most = document["failure_probability"], document["most_scenarios"]
    found = probability["high"] - probability["low"]
    if found <= width:
        return [
            f"Stopped after {document['scenarios']} of at most {most}: {found:.3g} wide, {width:g} wanted."
        ]
    return [f"Not as narrow as wanted after all {most} scenarios: {found:.3g} wide, {width:g} wanted."]


def _size(value: float, endless: str = "no result") -> str:
    return endless if value == float("inf") else f"{value:.4g}"


def _share(value: float) -> str:
    return "-" if value == float("inf") else f"{100 * value:.3g} %"
