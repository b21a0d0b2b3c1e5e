"""Summary of a mechanism, and a check that its contacts can be simulated within a reasonable time."""

from collections.abc import Callable

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning import terminal


def check_can_be_simulated(mechanism: AnyMechanism, label: str | None = None) -> None:
    """Raise `InputError` if the contacts of a mechanism cannot be simulated.

    With one axis, the check includes all draws of the uncertain parameters (see `plausibility.check_run`).
    With six axes, only the nominal run is checked. This function imports jax.
    """
    if isinstance(mechanism, SixAxisMechanism):
        from jaxhil.sixdof.building import build_scenarios
        from jaxhil.sixdof.plausibility import check_scenario

        check_scenario(mechanism, build_scenarios(mechanism))
        return
    from jaxhil.simulation.plausibility import check_run

    check_run(mechanism, label, drawn=True)


def report_summary(mechanism: AnyMechanism, tell: Callable[[str], None] | None) -> None:
    """Report the summary of a one-axis mechanism, and print warnings of implausible values.

    The summary is passed to `tell`, unless `tell` is None. For six axes, this function does nothing; only
    `jaxhil simulate` reports such a summary. This function imports jax.
    """
    if isinstance(mechanism, SixAxisMechanism):
        return
    from jaxhil.simulation.plausibility import summarise_mechanism

    summary = summarise_mechanism(mechanism)
    if tell is not None:
        tell(summary.line(mechanism.name))
    terminal.warn(f"{mechanism.name}: {warning}" for warning in summary.warnings)
