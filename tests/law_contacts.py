"""Contacts of the rig plant with the impulse ledger, in lock-step."""

from collections.abc import Iterator
from typing import NamedTuple

import c99_cases
import numpy as np

from jaxhil.mechanism.file import load, to_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.rig import Controller
from tuning.rig.numerical_model import NumericalModel
from tuning.rig.plant import RigHardware

LAW = "impulse_ledger"
AFTER = 60  # ticks simulated after model and hardware have left the surface
LONGEST = 2000


class Ran(NamedTuple):
    """Record of a contact, tick by tick: rows of `c99_cases.ROW`, faults, and compensator status."""

    rows: np.ndarray
    faults: np.ndarray
    said: list[str]


def run(mechanism: Mechanism, law: Controller, seed: int = 0) -> Ran:
    """Simulate one contact in lock-step with the rig plant, until some time after its end."""
    plant, model = RigHardware(mechanism, seed), NumericalModel(to_plain_data(mechanism))
    period, quiet, entered = law.control_period, 0, False
    surface = min(mechanism.rig.contact_plane, 0.0)
    position, velocity = model.start
    model.place(position, velocity)
    plant.begin(position, velocity, law.position_command(position, velocity, 0.0), 0)
    rows, faults, statuses = [], [], []
    for tick in range(LONGEST):
        force, measured = plant.read()
        readings = [force, model.position, model.velocity, measured, tick * period]
        command = law.step(*readings)
        model.integrate(0.0 if tick == 0 else command)
        motion = [model.position, model.velocity, model.acceleration]
        plant.move(law.position_command(*motion))
        rows.append([c99_cases.TICK, *readings, 1.0, *motion])
        faults.append(law.faults)
        statuses.append(law.law_status)
        touching = readings[1] > surface or measured > surface
        entered, quiet = entered or touching, 0 if touching else quiet + 1
        if entered and quiet > AFTER:
            break
    return Ran(np.array(rows), np.array(faults), statuses)


def contacts_of(suite: str, seed: int, number: int, changes: tuple[str, ...] = ()) -> Iterator[Mechanism]:
    """Yield contacts of this many draws of a suite, with the overrides applied."""
    drawn = draw(load(f"suite-{suite}", list(changes)).mechanism, number, seed)
    for index in range(number):
        one = {path: values[index].tolist() for path, values in drawn.items()}
        one["approach.phase"] = one["approach.phase"][0]
        yield load(
            f"suite-{suite}", [*changes, *(f"{path}={value}" for path, value in one.items())]
        ).mechanism
