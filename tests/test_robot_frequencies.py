"""Highest contact frequency that each built-in rig with industrial robots supports, and its compensator.

`pytest -m slow -s tests/test_robot_frequencies.py` prints the table of the guide's page on compensators.
"""

import math
from pathlib import Path

import pytest

import jaxhil
import tuning

ROBOTS = ("two-robots-250hz", "robot-34ms", "robot-50ms", "robot-150ms")
COMPENSATORS = (
    *("multi_parameter_lead", "smith_predictor", "position_lead", "response_error"),
    "impulse_ledger",
)
FREQUENCIES = (0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)  # Hz
# highest frequency [Hz]; beyond it all runs diverge alike, and metrics have no interval
SLOW_FREQUENCIES = {"robot-150ms": (0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5)}
LARGEST_RMS, LEAST_TRANSPARENCY = 0.01, 0.8
SCENARIOS = 32
GUIDE = Path(__file__).parent.parent / "notebooks/guide/which_compensator.md"


def at_frequency(robot, frequency):
    stiffness = jaxhil.load(robot).bodies.mass * (2 * math.pi * frequency) ** 2
    name = f"{robot} at {frequency:g} Hz"
    return jaxhil.load(robot, {"name": name, "contact.stiffness": [stiffness]})


def row(robot, compensator, boards):
    """Return the row of the table for the highest frequency up to which all frequencies are good."""
    frequencies, highest, text = SLOW_FREQUENCIES.get(robot, FREQUENCIES), 0.0, "- | -"
    for frequency, board in zip(frequencies, boards, strict=True):
        (metrics,) = board.figures[compensator].values()
        rms, early, late = (getattr(metrics, name).value for name in ("rms", "early", "late"))
        if not (rms <= LARGEST_RMS and min(early, late) >= LEAST_TRANSPARENCY):
            break
        highest, text = frequency, f"{rms:.4f} | {early:.2f}, {late:.2f}"
    frequency = f"{highest:g} Hz" if highest else f"below {frequencies[0]:g} Hz"
    return f"| `{robot}` | `{compensator}` | {frequency} | {text} |"


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_guide_states_highest_contact_frequency_of_robot(robot):
    boards = tuning.compare(
        [at_frequency(robot, frequency) for frequency in SLOW_FREQUENCIES.get(robot, FREQUENCIES)],
        COMPENSATORS,
        untuned=True,
        judged=SCENARIOS,
    )
    rows = [row(robot, compensator, boards) for compensator in COMPENSATORS]
    print(*rows, sep="\n")
    guide = GUIDE.read_text(encoding="utf-8")
    assert [line for line in rows if line not in guide] == []
