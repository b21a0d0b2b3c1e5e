"""Tables and sentences that `jaxhil sweep` prints from its JSON document."""

from typing import Any

from jaxhil.errors import to_one_line
from tuning import terminal


def print_sweep(document: dict[str, Any]) -> None:
    """Print a sweep's tables and its verdict on standard output."""
    terminal.emit(*_build_tables(document), *_summary_lines(document))


def _build_tables(document: dict[str, Any]) -> list[Any]:
    """Return the tables of outcomes, quantiles, worst scenarios, and Sobol indices and rare events if any."""
    number = document["scenarios"]
    title = f"{document['mechanism']}, compensation: {document['compensator']}, {number} scenarios"
    outcomes = terminal.build_table(
        f"{title} ({document['sampling']}, {document['precision']})",
        ["outcome", "scenarios", "share"],
        [(name, count, count / number) for name, count in document["outcomes"].items()],
    )
    # The inputs do not fit into the table; `jaxhil replay` prints those of one scenario.
    worst = terminal.build_table(
        "Worst scenarios",
        ["index", "outcome", "error", "episode" if document["axes"] == 6 else "contact"],
        [
            (
                scenario["index"],
                scenario["outcome"],
                terminal.format_error(scenario["worst_error"]),
                terminal.format_number(scenario["worst_contact"]),
            )
            for scenario in document["worst"]
        ],
        texts=(1,),
    )
    symbol = "|error|" if document["axes"] == 6 else "|e - e*|"
    tables = [outcomes, _quantile_table(document, symbol), worst]
    if "drivers" in document:
        tables.append(_sobol_index_table(document["drivers"], symbol))
    if "rare" in document:
        tables.append(_subset_simulation_table(document["rare"]))
    return tables


def _summary_lines(document: dict[str, Any]) -> list[str]:
    """Return the sentences below the tables; the last sentences state the verdict and the files written."""
    from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS_SHORT_TEXT
    from jaxhil.simulation.metrics import CONTACT_STATUS_REASONS
    from tuning.sweeps.columns import UNLIKE_IDEAL, UNLIKE_IDEAL_MEANING

    probability, number, limit = (document[key] for key in ("failure_probability", "scenarios", "limit"))
    within = "infinite" if limit is None else f"{limit:g}"
    lines = [
        f"Failure probability {probability['value']:.4g}, 95 % interval {probability['low']:.3g} to "
        f"{probability['high']:.3g} ({probability['method']}); {document['failed']} of {number} failed. "
        f"Limits: {'twist' if document['axes'] == 6 else 'restitution'} error {within}; "
        f"real contact: {CONTACT_BOUNDS_SHORT_TEXT}."
    ]
    lines += _describe_interval_width(document)
    if UNLIKE_IDEAL in document["outcomes"]:
        lines.append(f"{UNLIKE_IDEAL}: {UNLIKE_IDEAL_MEANING}.")
    lines += [
        f"{name}: {CONTACT_STATUS_REASONS[name]}."
        for name in document["outcomes"]
        if name in CONTACT_STATUS_REASONS
    ]
    if left_out := document["left_out_of_replicates"]:
        lines.append(
            f"The last {left_out} scenarios do not fill a replicate; probability and quantiles exclude them."
        )
    if document.get("rare", {}).get("spread_beyond_formula"):
        lines.append(
            "The replicates of the subset simulation differ far more than its formula explains: some have "
            "missed failures, and the interval may be wrong."
        )
    if (compared := document.get("float32")) is not None:
        lines.append(
            f"float32 compared with float64 on {compared['scenarios']} scenarios: errors differ by at most "
            f"{terminal.format_number(compared['largest_difference'], 2)}; {compared['changed_outcomes']} "
            f"outcomes differ; {compared['failed_float32']} (float32) and {compared['failed_float64']} "
            "(float64) scenarios failed."
        )
    if document["scenarios_per_second"]:
        lines.append(f"{document['scenarios_per_second']:.0f} scenarios per second.")
    acceptable = document["acceptable"]
    requirement = "no scenario may fail" if acceptable is None else f"acceptable up to {acceptable:g}"
    lines.append(f"{document['verdict'].capitalize()}: {requirement}. Wrote {to_one_line(document['store'])}")
    lines += [f"Wrote {to_one_line(path)}" for path in document["plots"]]
    return lines


def _quantile_table(document: dict[str, Any], symbol: str):
    return terminal.build_table(
        f"Worst {symbol} of a scenario",
        ["share of scenarios", "|error| up to", "95 % from", "to"],
        [
            (
                f"{100 * quantile['order']:g} %",
                _format_error(quantile["value"]),
                _format_error(quantile["low"]),
                _format_error(quantile["high"], "no bound"),
            )
            for quantile in document["error_quantiles"]
        ],
    )


def _sobol_index_table(drivers: dict[str, Any], symbol: str):
    """Return the table of each input's first-order and total Sobol indices, with confidence intervals."""
    return terminal.build_table(
        f"Sobol indices of the worst {symbol}, errors clipped at {drivers['cap']:g} ({drivers['capped']} of "
        f"{drivers['evaluations']} runs): shares of the variance",
        ["input", "first order", "95 % from", "to", "total", "95 % from", "to"],
        [
            (shares.input, *("-" if number != number else f"{number:.3f}" for number in shares[1:]))
            for shares in drivers["inputs"]
        ],
    )


def _subset_simulation_table(rare: dict[str, Any]):
    return terminal.build_table(
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
                *(_format_share(rare[f"{key}coefficient_of_variation"]) for key in ("", "formula_")),
                rare["evaluations"],
            )
        ],
    )


def _describe_interval_width(document: dict[str, Any]) -> list[str]:
    """Return a list: a sentence on the confidence interval's width, or nothing without `--until-width`."""
    width = document["until_width"]
    if width is None:
        return []
    probability, most = document["failure_probability"], document["most_scenarios"]
    reached = probability["high"] - probability["low"]
    if reached <= width:
        return [
            f"Stopped after {document['scenarios']} of at most {most} scenarios: the interval's width is "
            f"{reached:.3g}, requested {width:g}."
        ]
    return [f"After all {most} scenarios, the interval's width is {reached:.3g}, requested {width:g}."]


def _format_error(value: float, infinite: str = "no result") -> str:
    return infinite if value == float("inf") else f"{value:.4g}"


def _format_share(value: float) -> str:
    return "-" if value == float("inf") else f"{100 * value:.3g} %"
