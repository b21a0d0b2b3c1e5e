"""Small tuning tasks for tests of the search: phase lead with a motion simulator that it can compensate."""

from jaxhil.mechanism.file import load
from tuning.gains.tasks import TuneTask, build_task

SCENARIOS = 8
FAST = ["rig.simulator.natural_frequency=60", "rig.simulator.delay=0.001"]
STIFFNESSES = "[1e5]", "[4e4]", "[2e5]"


def lead_tasks() -> list[TuneTask]:
    """Return three tasks that differ only in stiffness and name."""
    return [
        lead_task(f"contact.stiffness={stiffness}", f"name=m{i}") for i, stiffness in enumerate(STIFFNESSES)
    ]


def lead_task(*overrides: str) -> TuneTask:
    """Return a task whose mechanism is rig-300kg with `FAST` and further overrides."""
    mechanism = load("rig-300kg", [*overrides, *FAST]).mechanism
    return build_task(mechanism, "phase_lead", SCENARIOS, 0)
