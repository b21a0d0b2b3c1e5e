"""Replay of recorded runs through the rig's controller, to obtain the tick and cause of a trip."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxhil.rig import Controller, digest
from jaxhil.simulation.gain_file import LoadedGains
from tuning.watchdog.recording import RecordedSignals


class Tripped(NamedTuple):
    """Time and reason of a run's trip.

    tick: tick of the record at which the controller tripped; the number of ticks if it tripped after the last
    one. status: status of the controller, which contains the reason.
    """

    tick: int
    status: str


def limited_controller(loaded: LoadedGains, limits: Mapping[str, Mapping[str, Any]]) -> Controller:
    """Return the controller of a gain file with these `limits`."""
    document = {**loaded.document, "limits": dict(limits)}
    return Controller.from_dict({**document, "sha256": digest(document)})


def replay_lane(controller: Controller, signals: RecordedSignals, lane: int, mass: float) -> Tripped | None:
    """Feed one lane's record to the controller; return None if it never trips.

    The numerical model moves as recorded, even after a trip. At the end the next contact is announced, as
    between the contacts of a run.
    """
    if not controller.reset():
        raise ValueError("the controller's emergency stop is active")
    live = signals.live[:, lane]
    ticks = int(live.sum())
    force, position, velocity, measured = (leaf[:ticks, lane].tolist() for leaf in signals[:4])
    command = signals.command[:ticks, lane].tolist()
    begins = signals.begins[:ticks, lane].tolist()
    period = controller.control_period
    for tick in range(ticks):
        if tick and begins[tick]:
            controller.next_contact()
        if not controller.tripped:
            controller.step(force[tick], position[tick], velocity[tick], measured[tick])
        if not controller.tripped:
            acceleration = -command[tick] / mass
            moved = velocity[tick] + period * acceleration
            controller.position_command(position[tick] + period * moved, moved, acceleration)
        if controller.tripped:
            return Tripped(tick, controller.status)
    controller.next_contact()
    if controller.tripped:
        return Tripped(ticks, controller.status)
    return None
