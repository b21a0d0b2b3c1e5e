"""Simulated rig with one axis for the rehearsal: hardware, and detection of its contacts.

If the mechanism has one surface, every run has one contact and starts at the nominal approach speed. If the
mechanism has two surfaces, every run has `approach.contacts` contacts. The runs cycle through the lists of
stiffness and damping. From the second cycle on, the phase of each run is random.
"""

import math
from collections.abc import Sequence
from random import Random
from typing import Any

import numpy as np

from jaxhil.mechanism.structs import Mechanism
from tuning.rig.contact_detector import ContactDetector, RigContact
from tuning.rig.numerical_model import APPROACH_TIME
from tuning.rig.plant import RigHardware
from tuning.rig.udp_protocol import AnswerPacket, Numbers


class OneAxisRig:
    """Simulated rig with one axis.

    Args:
        mechanism: mechanism and rig to simulate.
        seed: seed of the sensor noise and of the random phases (instants of contact in a control period).
    """

    axes = 1
    error_name = "error"  # error that decides the verdict: the restitution error
    good_statuses = ("ok",)

    def __init__(self, mechanism: Mechanism, seed: int = 0) -> None:
        self._mechanism, self._period = mechanism, mechanism.rig.control_period
        self._two_sided = math.isfinite(mechanism.contact.clearance)
        self._plant, self._watch = RigHardware(mechanism, seed), ContactDetector(mechanism)
        self._phases = Random(seed + 1)
        self._runs, self._number, self._reading = 0, 0, 0.0

    def prepare(self, last: RigContact | None) -> Numbers:
        """Prepare the run after the contact `last`, with the hardware at rest; return the run's start."""
        mechanism = self._mechanism
        approach = mechanism.approach
        if last is not None:
            self._number = 0 if self._two_sided else (last.number + 1) % approach.contacts
        self._runs += 1
        is_first_cycle = self._runs <= (1 if self._two_sided else approach.contacts)
        phase = approach.phase if is_first_cycle else self._phases.random()
        nearer = min(mechanism.rig.contact_plane, 0.0)
        position = nearer - approach.velocity * (APPROACH_TIME + phase * self._period)
        self._start = position, approach.velocity
        self._plant.begin(position, 0.0, position, self._number)
        return self._start

    def begin(self, command: Numbers) -> None:
        """Begin the prepared run in uniform motion, with this position command of tick 0 [m]."""
        position, velocity = self._start
        runs = 1 if self._two_sided else self._mechanism.approach.contacts  # runs in a scenario
        self._plant.begin(position, velocity, command[0], self._number, (self._runs - 1) // runs)
        self._watch.begin(self._number)

    def read(self) -> tuple[Numbers, Numbers]:
        """Return the measured force [N] and position [m] just before this tick's command acts."""
        self._reading, position = self._plant.read()
        return (self._reading,), (position,)

    def advance(self, answer: AnswerPacket | None, command: Numbers) -> RigContact | None:
        """Advance by one control period; return the contact that ends at this tick, or None.

        Args:
            answer: newest answer of the controller in this run, or None before the first one.
            command: position command for the end of the period [m].
        """
        (position, velocity), force = self._start, 0.0
        if answer is not None:
            position, velocity, force = answer.position[0], answer.velocity[0], answer.force_command[0]
        contact = self._watch.observe(position, velocity, force, self._plant.force, self._reading)
        self._plant.move(command[0])
        return contact

    def continues_after(self, contact: RigContact) -> bool:
        """Return whether the run has a further contact; if so, set its contact law."""
        following = contact.number + 1
        has_next = self._two_sided and following < self._mechanism.approach.contacts
        if has_next and contact.status == "ok":
            self._plant.expect(following)
            return True
        return False

    def cut(self, status: str) -> RigContact | None:
        """End the current contact with the given status; return this contact, or None if there is none."""
        return self._watch.cut(status)

    def evaluate(self, contacts: Sequence[RigContact]) -> list[dict[str, Any]]:
        """Return the contacts with the error of the restitution; this imports JAX."""
        references = ideal_restitutions(self._mechanism, contacts)
        return [
            {
                **contact._asdict(),
                "reference_restitution": reference,
                "error": contact.restitution - reference if contact.status == "ok" else None,
            }
            for contact, reference in zip(contacts, references, strict=True)
        ]


def ideal_restitutions(mechanism: Mechanism, contacts: Sequence[RigContact]) -> list[float]:
    """Return the ideal restitution e* of each contact at its approach speed; this imports JAX."""
    if not contacts:
        return []
    from jaxhil.simulation.jax_environment import prepare_jax

    prepare_jax()
    import jax

    from jaxhil.contact.laws import find_contact_law
    from jaxhil.simulation.outcome import parameters_by_slot
    from jaxhil.simulation.scenario import build_scenarios

    scenario = build_scenarios(mechanism)
    number = np.array([contact.number for contact in contacts])
    parameters = jax.tree.map(lambda leaf: leaf[number], scenario.contact)
    speeds = [contact.approach_velocity for contact in contacts]
    velocity = np.array([speed if speed > 0.0 else 1.0 for speed in speeds])[:, None]
    mass = np.broadcast_to(scenario.equivalent_mass, velocity.shape)
    law = find_contact_law(mechanism.contact.law).simulation_law
    ideal = jax.jit(lambda contact, *motion: law.ideal_contact(parameters_by_slot(contact), *motion))
    return [float(value) for value in np.asarray(ideal(parameters, mass, velocity).restitution)[:, 0]]
