"""Faults injected tick by tick: the controller raises exactly these; outputs stay finite and limited."""

from collections.abc import Iterable

import c99_cases
import numpy as np
import pytest
from c99_cases import RESULT, controller_in_python, loaded, packed
from fault_runs import LIMITED, PERIOD, FaultRun, document, fault_run

from jaxhil.rig import COMPENSATORS
from jaxhil.rig.faults import FAULTS, fault_names
from jaxhil.rig.gain_file import check_gain_document

BLOCK = 500_000
# These faults need a closed loop, a faulty compensator or a call; the guard and watchdog tests cover them.
ELSEWHERE = (
    "command_not_finite",
    "restitution",
    "energy_balance",
    "contact_too_long",
    "emergency_stop",
    "tare",
    "law_in_doubt",
)
needs_compiler = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")


def check(run: FaultRun, results: np.ndarray) -> None:
    """Raise AssertionError for the first tick with wrong faults or outputs."""
    force, position = results[:, RESULT.index("force")], results[:, RESULT.index("position")]
    faults = results[:, RESULT.index("faults")].astype(np.int64)
    wrong = run.wrong(faults, results[:, RESULT.index("tripped")] != 0)
    if len(wrong):
        tick = wrong[0]
        raise AssertionError(
            f"tick {tick}: raised {fault_names(int(faults[tick]))}, expected "
            f"{fault_names(int(run.faults[tick]))}, "
            f"row {run.rows[tick].tolist()}"
        )
    assert np.all(np.isfinite(force)) and np.all(np.isfinite(position))
    assert np.all(np.abs(force) <= LIMITED["force_limit"])
    assert np.all(np.abs(np.diff(force)) <= LIMITED["force_slew"] * PERIOD * (1 + 1e-12))
    assert np.all((position >= LIMITED["command_lowest"]) & (position <= LIMITED["command_highest"]))
    assert np.all(np.abs(np.diff(position)) <= LIMITED["velocity_limit"] * PERIOD * (1 + 1e-9))


def counts(run: FaultRun) -> dict[str, int]:
    """Return the number of ticks that raise each fault."""
    return {fault.name: int(np.count_nonzero(run.faults & fault.bit)) for fault in FAULTS}


def python_runs(ticks: int, law: str, seed: int) -> None:
    gain_file = check_gain_document(document(law))
    for part in range(max(1, ticks // BLOCK)):
        run = fault_run(min(ticks, BLOCK), seed + part, law)
        check(run, controller_in_python(gain_file, run.rows))


def c_runs(ticks: int, law: str, seed: int) -> None:
    batch = loaded(law)
    gain_file = check_gain_document(document(law))
    for part in range(max(1, ticks // BLOCK)):
        run = fault_run(min(ticks, BLOCK), seed + part, law)
        assert batch.begin(packed(law, gain_file))
        check(run, batch.run(run.rows, guarded=True))


def test_fault_run_injects_every_fault_of_a_rig():
    injected = counts(fault_run(60_000, 0, "none"))
    assert [name for name, count in injected.items() if count == 0] == list(ELSEWHERE)


def test_check_of_fault_runs_detects_fault_that_was_not_raised():
    run = fault_run(2000, 0, "none")
    results = controller_in_python(check_gain_document(document("none")), run.rows)
    check(run, results)
    raised = np.nonzero(results[:, RESULT.index("faults")])[0]
    results[raised[0], RESULT.index("faults")] = 0
    with pytest.raises(AssertionError, match="raised"):
        check(run, results)


# Faults are raised around the compensator and do not depend on it.
FEW = ("none", "response_error")


def few_of(laws: Iterable[str]) -> pytest.MarkDecorator:
    """Parametrise `law`: compensators of `FEW` every day, the others as slow tests."""
    marked = [pytest.param(law, marks=() if law in FEW else pytest.mark.slow) for law in laws]
    return pytest.mark.parametrize("law", marked)


@few_of(COMPENSATORS)
def test_python_controller_raises_every_fault_on_its_tick(law):
    python_runs(20_000, law, 10)


@needs_compiler
@few_of(COMPENSATORS)
def test_c99_controller_raises_every_fault_on_its_tick(law):
    c_runs(60_000, law, 20)


@pytest.mark.slow
@pytest.mark.parametrize("law", COMPENSATORS)
def test_python_controller_raises_every_fault_in_run_of_ten_million_ticks(law):
    python_runs(10_000_000 if law == "response_error" else 1_000_000, law, 1000)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("law", COMPENSATORS)
def test_c99_controller_raises_every_fault_in_run_of_hundred_million_ticks(law):
    c_runs(100_000_000 if law == "response_error" else 10_000_000, law, 2000)
