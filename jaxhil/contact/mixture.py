"""Any of several contact laws, lane by lane: one compiled program for mechanisms whose laws differ.

Every law is evaluated on every lane, and each lane takes its own: a few operations more per tick, against a
program to compile for each law.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.contact.laws import ContactLaw, ContactParameters
from jaxhil.contact.reference import Reference


class AnyOf(ContactLaw):
    """The law number `kind` of `laws`, a leaf of the parameters.

    Stiffness and depths have a leading axis of segments, as for the piecewise-linear law; the other laws take
    the first. A lane's numbers mean to its own law what they always mean; the others see them without
    damping.

    `beforehand` says that references without a closed form come with the scenarios (`Scenario.reference`):
    here they are then NaN.
    """

    laws: tuple[ContactLaw, ...]
    beforehand: bool = False

    @property
    def closed_form(self):
        return self.beforehand or all(law.closed_form for law in self.laws)

    @property
    def remembers(self):
        return any(law.remembers for law in self.laws)

    @property
    def jumps(self):
        return any(law.jumps for law in self.laws)

    def init(self, penetration):
        return tuple(law.init(penetration) for law in self.laws)

    def step(self, parameters, state: Any, penetration, rate):
        found = [
            law.step(own, memory, penetration, rate)
            for law, own, memory in zip(self.laws, self._own(parameters), state, strict=True)
        ]
        return self._choose(parameters, [force for force, _ in found]), tuple(memory for _, memory in found)

    def edge(self, parameters, rate):
        own = zip(self.laws, self._own(parameters), strict=True)
        return self._choose(parameters, [law.edge(one, rate) for law, one in own])

    def corners(self, parameters, state: Any):
        own = zip(self.laws, self._own(parameters), state, strict=True)
        return tuple(corner for law, one, memory in own for corner in law.corners(one, memory))

    def hold(self, parameters, state: Any, penetration, rate):
        own = zip(self.laws, self._own(parameters), state, strict=True)
        return self._choose(
            parameters, [law.hold(one, memory, penetration, rate) for law, one, memory in own]
        )

    def reference(self, parameters, mass, velocity):
        unknown = Reference(*[jnp.full_like(velocity, jnp.nan)] * 3)
        found = [
            law.reference(own, mass, velocity) if law.closed_form or not self.beforehand else unknown
            for law, own in zip(self.laws, self._own(parameters), strict=True)
        ]
        return Reference(*(self._choose(parameters, list(leaves)) for leaves in zip(*found, strict=True)))

    def _own(self, parameters: ContactParameters) -> list[ContactParameters]:
        every = []
        for kind, law in enumerate(self.laws):
            damping = jnp.where(parameters.kind == kind, parameters.damping, 0)
            stiffness = parameters.stiffness if law.segmented else parameters.stiffness[0]
            every.append(parameters._replace(stiffness=stiffness, damping=damping, kind=None))
        return every

    def _choose(self, parameters: ContactParameters, values: Sequence[Array]) -> Array:
        """Each lane's own value."""
        chosen = jnp.asarray(values[0])
        for kind, value in enumerate(values[1:], start=1):
            chosen = jnp.where(parameters.kind == kind, value, chosen)
        return chosen
