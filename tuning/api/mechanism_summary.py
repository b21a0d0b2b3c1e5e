"""Summary of a mechanism before a computation, and a check that the computation would end."""

from collections.abc import Callable

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning import terminal


def check_can_be_simulated(mechanism: AnyMechanism, label: str | None = None) -> None:
    """Check that the contacts of a mechanism can be simulated.

    Raise `InputError` if a contact, nominal or drawn, takes too many ticks or, in six axes, if the nominal
    run cannot begin. This imports jax.
    """
    if isinstance(mechanism, SixAxisMechanism):
        from jaxhil.sixdof.building import build_scenarios
        from jaxhil.sixdof.plausibility import check_scenario

        check_scenario(mechanism, build_scenarios(mechanism))
        return
    from jaxhil.simulation.plausibility import check_run

    check_run(mechanism, label, drawn=True)


def report_summary(mechanism: AnyMechanism, tell: Callable[[str], None] | None) -> None:
    """Report the summary of a one-axis mechanism by `tell`, if given, and warn of implausible values.

    This imports jax. In six axes it does nothing; `jaxhil simulate` reports the summary.
    """
    if isinstance(mechanism, SixAxisMechanism):
        return
    from jaxhil.simulation.plausibility import summarise_mechanism

    summary = summarise_mechanism(mechanism)
    if tell is not None:
        tell(summary.line(mechanism.name))
    terminal.warn(f"{mechanism.name}: {warning}" for warning in summary.warnings)
