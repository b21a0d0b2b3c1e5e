"""Contact law selected per batch element: one compiled program for mechanisms with different laws.

Every law is evaluated for every batch element, which then takes the result of its law. This costs a few
operations per tick, but saves compiling one program per law.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.laws import ContactLaw, ContactParameters


class LawMixture(ContactLaw):
    """Contact law that applies the law number `parameters.kind` of `laws` to each batch element.

    Stiffness and depths have a leading axis of segments, as for the piecewise-linear law; the other laws take
    the first segment. A batch element's parameters keep their meaning for its law; the other laws get them
    without damping.

    If `beforehand` is true, ideal contacts without a closed form come with the scenarios
    (`Scenario.reference`), and `reference` returns NaN for them.
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
        results = [
            law.step(numbers, memory, penetration, rate)
            for law, numbers, memory in zip(self.laws, self._per_law(parameters), state, strict=True)
        ]
        forces, states = zip(*results, strict=True)
        return self._choose(parameters, forces), states

    def edge(self, parameters, rate):
        laws = zip(self.laws, self._per_law(parameters), strict=True)
        return self._choose(parameters, [law.edge(numbers, rate) for law, numbers in laws])

    def corners(self, parameters, state: Any):
        laws = zip(self.laws, self._per_law(parameters), state, strict=True)
        return tuple(corner for law, numbers, memory in laws for corner in law.corners(numbers, memory))

    def hold(self, parameters, state: Any, penetration, rate):
        laws = zip(self.laws, self._per_law(parameters), state, strict=True)
        values = [law.hold(numbers, memory, penetration, rate) for law, numbers, memory in laws]
        return self._choose(parameters, values)

    def reference(self, parameters, mass, velocity):
        unknown = IdealContact(*[jnp.full_like(velocity, jnp.nan)] * 3)
        references = [
            law.reference(numbers, mass, velocity) if law.closed_form or not self.beforehand else unknown
            for law, numbers in zip(self.laws, self._per_law(parameters), strict=True)
        ]
        return IdealContact(*(self._choose(parameters, leaves) for leaves in zip(*references, strict=True)))

    def _per_law(self, parameters: ContactParameters) -> list[ContactParameters]:
        """Return the parameters as each law takes them."""
        per_law = []
        for kind, law in enumerate(self.laws):
            damping = jnp.where(parameters.kind == kind, parameters.damping, 0)
            stiffness = parameters.stiffness if law.segmented else parameters.stiffness[0]
            per_law.append(parameters._replace(stiffness=stiffness, damping=damping, kind=None))
        return per_law

    def _choose(self, parameters: ContactParameters, values: Sequence[Array]) -> Array:
        """Return for each batch element the value of its law."""
        chosen = jnp.asarray(values[0])
        for kind, value in enumerate(values[1:], start=1):
            chosen = jnp.where(parameters.kind == kind, value, chosen)
        return chosen
