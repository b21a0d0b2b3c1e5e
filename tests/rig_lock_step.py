"""Rig plant and runtime controller in lock-step: virtual time, no network, no jax."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from hypothesis import strategies as st

from jaxhil.mechanism.file import to_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import Controller
from jaxhil.rig.gain_file import GainFile
from tuning.rig.contact_detector import ContactDetector, RigContact
from tuning.rig.numerical_model import APPROACH_TIME, NumericalModel, OneAxisModelInLoop
from tuning.rig.plant import RigHardware
from tuning.rig.rig_task import RigTask, build_simulated_rig
from tuning.rig.udp_protocol import PREPARE, READY, TICK, AnswerPacket, ReadingPacket
from tuning.rig.udp_task import ControllerTask

ANY = st.floats(width=64)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


def controller(mechanism: Mechanism, compensator: str, gains: Mapping[str, float], **limits: float):
    """Return the runtime controller for a mechanism."""
    made = GainFile(compensator, gains, mechanism.rig.control_period, mechanism.contact.clearance)
    return Controller(made._replace(limits={**made.limits, **limits}))


def closed_loop(
    mechanism: Mechanism, compensator: str, gains: Mapping[str, float], seed: int = 0
) -> tuple[list[RigContact], dict[int, float]]:
    """Return the contacts of the mechanism as in `jaxhil simulate`, and the position shortfalls.

    Each contact starts at the rebound speed of the previous contact. Shortfalls are the largest of each
    contact [m].
    """
    law, plant, detector = (
        controller(mechanism, compensator, gains),
        RigHardware(mechanism, seed),
        ContactDetector(mechanism),
    )
    raw = to_plain_data(mechanism)
    model, sensor = NumericalModel(raw), mechanism.rig.force_sensor
    zeroed = sensor.noise_std != 0 or sensor.bias != 0
    (position, velocity), results, shortfalls = model.start, [], {}
    while len(results) < mechanism.approach.contacts:
        number, tick, shortfall = len(results), 0, []
        model.place(position, velocity)
        plant.begin(position, velocity, law.position_command(position, velocity, 0.0), number)
        detector.begin(number)
        while len(results) < mechanism.approach.contacts:
            reading, measured = plant.read()[0], plant.read()[1]
            force = law.step(reading, model.position, model.velocity, measured)
            force = 0.0 if zeroed and tick == 0 else force
            over = detector.observe(model.position, model.velocity, force, plant.force, reading)
            shortfall.append(plant.shortfall)
            model.integrate(force)
            plant.move(law.position_command(model.position, model.velocity, model.acceleration))
            tick += 1
            if over is not None:
                shortfalls[len(results)] = max(shortfall[over.onset_tick :])
                results.append(over)
                if over.status != "ok" or math.isinf(mechanism.contact.clearance):
                    break
                plant.expect(len(results))
        if results[-1].status != "ok":
            break
        velocity = results[-1].restitution * results[-1].approach_velocity
        position = min(mechanism.rig.contact_plane, 0.0)
        position -= velocity * (APPROACH_TIME + mechanism.approach.phase * mechanism.rig.control_period)
        law.next_contact()
    return results, shortfalls


def packets(
    mechanism: Mechanism,
    law: Controller,
    ticks: int,
    delivered: Callable[[str, Any], list[Any]] = lambda way, packet: [packet],
    seed: int = 0,
    resets: bool = False,
) -> tuple[RigTask, ControllerTask, list[AnswerPacket]]:
    """Exchange packets between rig and controller for the given number of ticks.

    `delivered(way, packet)` returns the packets that arrive at this tick when `packet` is sent `"there"` or
    `"back"`.
    """
    period = mechanism.rig.control_period
    rig = RigTask(build_simulated_rig(mechanism, seed), period, resets=resets)
    task = task_of(law, mechanism)
    answers = []
    for _ in range(ticks):
        packet: ReadingPacket = rig.reading()
        for reading in delivered("there", packet):
            answer = task.answer(reading)
            if answer is not None:
                answers.append(answer)
                for arrived in delivered("back", answer):
                    rig.take(arrived)
        rig.advance()
    return rig, task, answers


def same(one, other):
    """Return whether two packets hold the same numbers, including NaN."""

    def entries(packet):
        return [entry for field in packet for entry in (field if isinstance(field, tuple) else (field,))]

    return all(a == b or (a != a and b != b) for a, b in zip(entries(one), entries(other), strict=True))


def a_reading(tick, sequence=None, force=0.0, position=-1.0, event=TICK, run=1):
    """Return the reading packet of a tick."""
    sequence = tick + 10 if sequence is None else sequence
    time = 0.001 * sequence
    return ReadingPacket(event, sequence, run, tick, time, (force,), (position,), (-1.0, 0.005))


def task_of(law, mechanism):
    """Return the controller's task with a runtime controller."""
    return ControllerTask(law, OneAxisModelInLoop(law, to_plain_data(mechanism)))


def prepared(mechanism, **limits):
    """Return the controller's task with compensator `none`, ready for a run."""
    law = controller(mechanism, "none", {}, **limits)
    task = task_of(law, mechanism)
    assert task.answer(a_reading(0, 1, event=PREPARE)).flags == READY
    return task
