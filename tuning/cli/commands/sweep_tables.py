"""Tables and lines that `jaxhil sweep` prints from its document."""

from typing import Any

from jaxhil.errors import one_line
from tuning import terminal


def emit(document: dict[str, Any]) -> None:
    """Print the tables and the verdict on standard output."""
    terminal.emit(*_tables(document), *_lines(document))


def _tables(document: dict[str, Any]) -> list[Any]:
    """Return the tables of outcomes, quantiles, worst scenarios and additional studies."""
    number = document["scenarios"]
    title = f"{document['mechanism']}, compensation: {document['compensator']}, {number} scenarios"
    outcomes = terminal.table(
        f"{title} ({document['sampling']}, {document['precision']})",
        ["outcome", "scenarios", "share"],
        [(name, count, count / number) for name, count in document["outcomes"].items()],
    )
    # The inputs are too many for one table; `replay` prints them.
    worst = terminal.table(
        "Worst scenarios",
        ["index", "outcome", "error", "episode" if document["axes"] == 6 else "contact"],
        [
            (
                scenario["index"],
                scenario["outcome"],
                terminal.signed(scenario["worst_error"]),
                terminal.figure(scenario["worst_contact"]),
            )
            for scenario in document["worst"]
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
    """Return the sentences below the tables; the last ones are the verdict and the paths."""
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
    requirement = "no scenario may fail" if acceptable is None else f"acceptable up to {acceptable:g}"
    lines.append(f"{document['verdict'].capitalize()}: {requirement}. Wrote {one_line(document['store'])}")
    lines += [f"Wrote {one_line(path)}" for path in document["plots"]]
    return lines


def _quantiles(document: dict[str, Any], symbol: str):
    """Return the table of error quantiles with their confidence intervals."""
    return terminal.table(
        f"Worst {symbol} of a scenario",
        ["share of scenarios", "|error| up to", "95 % from", "to"],
        [
            (
                f"{100 * quantile['order']:g} %",
                _size(quantile["value"]),
                _size(quantile["low"]),
                _size(quantile["high"], "no bound"),
            )
            for quantile in document["error_quantiles"]
        ],
    )


def _drivers(drivers: dict[str, Any], symbol: str):
    """Return the table of Sobol indices."""
    return terminal.table(
        f"What drives the worst {symbol}, errors cut at {drivers['cap']:g} ({drivers['capped']} of "
        f"{drivers['evaluations']} runs): shares of the variance",
        ["input", "first order", "95 % from", "to", "total", "95 % from", "to"],
        [
            (shares.input, *("-" if number != number else f"{number:.3f}" for number in shares[1:]))
            for shares in drivers["inputs"]
        ],
    )


def _rare(rare: dict[str, Any]):
    """Return the table of the subset simulation."""
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
    """Return a sentence on the width of the interval if `--until-width` was given."""
    width = document["until_width"]
    if width is None:
        return []
    probability, most = document["failure_probability"], document["most_scenarios"]
    reached = probability["high"] - probability["low"]
    if reached <= width:
        return [
            f"Stopped after {document['scenarios']} of at most {most}: {reached:.3g} wide, {width:g} wanted."
        ]
    return [f"Not as narrow as wanted after all {most} scenarios: {reached:.3g} wide, {width:g} wanted."]


def _size(value: float, endless: str = "no result") -> str:
    """Return an error as text, or `endless` for infinity."""
    return endless if value == float("inf") else f"{value:.4g}"


def _share(value: float) -> str:
    """Return a share in percent as text, or a dash for infinity."""
    return "-" if value == float("inf") else f"{100 * value:.3g} %"
