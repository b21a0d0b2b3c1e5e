"""One compiled program for mechanisms that differ in contact law, number of segments or number of contacts.

In this program these properties are arrays with one value per lane (batch element). The program contains
every optional part of the loop that a mechanism needs; neutral parameters disable it for the others.
Mechanisms with two contact surfaces have a separate program, because the second surface slows every lane.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.laws import ContactLaw, ContactParameters, find_contact_law
from jaxhil.contact.mixture import LawMixture
from jaxhil.mechanism.six_axes import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw_extremes
from jaxhil.simulation.cells import NO_CELLS, CellCounts, merge_cell_counts
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.scenario import Scenario, build_scenarios

_OPTIONAL_FLAGS = (
    "has_lag",
    "has_force_bias",
    "has_force_noise",
    "has_position_noise",
    "has_sample_effects",
    "has_limits",
)
_DISTINGUISHING_PROPERTIES = (
    "integrator",
    "hold",
    "latency",
    "is_two_sided",
    "cuts_dead_zone",
    "sensor_filter",
)


@dataclass(frozen=True)
class CommonProgram:
    """Static properties of a compiled program that several mechanisms share."""

    laws: tuple[str, ...]  # names of the contact laws of all mechanisms
    segments: int  # largest number of segments of a contact law
    slots: int  # largest number of contacts in a run
    parts: tuple[str, ...]  # names of the optional parts of the loop that at least one mechanism needs
    discontinuity_order: int  # order of the lowest derivative of the motion that is discontinuous at a tick
    ring: int  # length of the delay lines [samples]
    cells: CellCounts  # numbers of integration cells in a control period
    precomputed: bool  # whether ideal contacts without a closed form are integrated before the simulation

    def law(self, precomputed: bool | None = None) -> LawMixture:
        """Return a contact law that applies to each lane the law of the lane's mechanism.

        For some laws, the ideal contact has no closed form. If `precomputed` is true, the scenarios must
        contain these ideal contacts; otherwise the returned law integrates them. None stands for
        `self.precomputed`.
        """
        return LawMixture(self._kinds, self.precomputed if precomputed is None else precomputed)

    @property
    def _kinds(self) -> tuple[ContactLaw, ...]:
        """Return the distinct contact laws to simulate; several names in `laws` can lead to the same law."""
        return tuple(dict.fromkeys(find_contact_law(name).simulation_law for name in self.laws))

    def loop(self, loop: Loop) -> Loop:
        """Set the static (compile-time) properties of one mechanism's loop to those of this program."""
        parts = {name: name in self.parts for name in _OPTIONAL_FLAGS}
        return dataclasses.replace(
            loop,
            law=self.law(),
            discontinuity_order=self.discontinuity_order,
            ring=max(self.ring, loop.ring),
            cells=merge_cell_counts([self.cells, loop.cells]),
            **parts,
        )

    def scenarios(self, mechanism: Mechanism, batch: Scenario) -> Scenario:
        """Adapt the scenarios of one mechanism to the array shapes of this program."""
        slots, number = batch.phase.shape
        chosen = np.minimum(np.arange(self.slots), slots - 1)

        def by_slot(leaf: Any) -> Any:
            return np.asarray(leaf)[chosen]

        contact = jax.tree.map(by_slot, batch.contact)
        stiffness, depths = contact.stiffness, contact.depths
        if stiffness.ndim == 2:
            stiffness = stiffness[:, None]
        missing = self.segments - stiffness.shape[1]
        # The added segments repeat the last stiffness, so that the contact model is unchanged.
        stiffness = np.concatenate([stiffness, np.repeat(stiffness[:, -1:], missing, axis=1)], axis=1)
        deepest = depths[:, -1:] if depths.shape[1] else np.full((self.slots, 1, number), UNREACHED_DEPTH)
        further = deepest * (1 + np.arange(1, self.segments))[None, :, None]
        depths = np.concatenate([depths, further], axis=1)[:, : self.segments - 1]
        law = find_contact_law(mechanism.contact.law).simulation_law
        kind: Any = np.full((self.slots, number), self._kinds.index(law), np.int32)
        contact = contact._replace(stiffness=stiffness, depths=depths, kind=kind)
        reference: Any = None
        if self.precomputed:
            unknown: Any = np.full((self.slots, number), np.nan)
            reference = IdealContact(*[unknown] * 3) if law.has_closed_form else self._first(law, batch)
        return batch._replace(contact=contact, phase=by_slot(batch.phase), reference=reference)

    def _first(self, law: ContactLaw, batch: Scenario) -> Any:
        """Compute the first ideal contact of every scenario; repeat it for all contacts of the scenario."""
        contact: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[0], batch.contact)
        reference = jax.device_get(
            _compute_ideal_contact(law, contact, batch.equivalent_mass, batch.velocity)
        )
        return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (self.slots, *leaf.shape)), reference)


UNREACHED_DEPTH = 1.0  # penetration that no contact reaches [m]


@partial(jax.jit, static_argnums=0)
def _compute_ideal_contact(
    law: ContactLaw, contact: ContactParameters, mass: Array, velocity: Array
) -> IdealContact:
    return law.ideal_contact(contact, mass, velocity)


def group_by_common_program(mechanisms: Sequence[AnyMechanism]) -> list[tuple[list[int], Any]]:
    """Group mechanisms that can share a compiled program; return (indices, program) of each group.

    The program is a `CommonProgram`. Each six-axis mechanism is a group of its own, with None as the program.
    """
    one_axis = [index for index, mechanism in enumerate(mechanisms) if isinstance(mechanism, Mechanism)]
    alone = [([index], None) for index in range(len(mechanisms)) if index not in one_axis]
    groups = _group_one_axis([mechanism for mechanism in mechanisms if isinstance(mechanism, Mechanism)])
    return [*(([one_axis[i] for i in group], common) for group, common in groups), *alone]


def _group_one_axis(mechanisms: Sequence[Mechanism]) -> list[tuple[list[int], CommonProgram]]:
    """Group one-axis mechanisms that can share a program; return (indices, program) of each group."""
    # These scenarios contain the ends of all uncertain ranges. They therefore need every part of the loop
    # that any other scenario can need.
    batches = [build_scenarios(mechanism, draw_extremes(mechanism)) for mechanism in mechanisms]
    loops = [build_loop(m, "none", batch) for m, batch in zip(mechanisms, batches, strict=True)]
    groups: dict[Any, list[int]] = {}
    for index, (loop, batch) in enumerate(zip(loops, batches, strict=True)):
        key = (
            *(getattr(loop, name) for name in _DISTINGUISHING_PROPERTIES),
            len(batch.simulator.denominator),
            jax.tree.structure((batch.simulator.window, batch.timing, batch.force_sensor.bias_walk)),
            _needs_simulated_speeds(mechanisms[index]),
        )
        groups.setdefault(key, []).append(index)
    return [
        (group, _build_common_program([mechanisms[i] for i in group], group, loops, batches))
        for group in groups.values()
    ]


def _needs_simulated_speeds(mechanism: Mechanism) -> bool:
    """Return whether ideal contacts must be integrated from approach speeds that the simulation yields."""
    return mechanism.approach.contacts > 1 and not find_contact_law(mechanism.contact.law).has_closed_form


def _build_common_program(mechanisms, group, loops, batches) -> CommonProgram:
    segments = [b.contact.stiffness.shape[1] if b.contact.stiffness.ndim == 3 else 1 for b in batches]
    return CommonProgram(
        laws=tuple(dict.fromkeys(mechanism.contact.law for mechanism in mechanisms)),
        segments=max(segments[i] for i in group),
        slots=max(batches[i].phase.shape[0] for i in group),
        parts=tuple(name for name in _OPTIONAL_FLAGS if any(getattr(loops[i], name) for i in group)),
        discontinuity_order=min(loops[i].discontinuity_order for i in group),
        ring=max(loops[i].ring for i in group),
        cells=_join_cell_counts(mechanisms, [loops[i] for i in group], [batches[i] for i in group]),
        precomputed=not _needs_simulated_speeds(mechanisms[0])
        and not all(loops[i].law.has_closed_form for i in group),
    )


def _join_cell_counts(mechanisms, loops, batches) -> CellCounts:
    """Return how many cells of a control period suffice for all mechanisms; `NO_CELLS` if none uses cells."""
    if not any(loop.has_cells for loop in loops):
        return NO_CELLS
    exact = [build_loop(m, "none", batch, exact=True) for m, batch in zip(mechanisms, batches, strict=True)]
    return merge_cell_counts([loop.cells for loop in exact])
