"""Contact law selected per batch element: one compiled program for mechanisms with different laws.

Every law is evaluated for every batch element; then the result of the element's own law is selected. This
costs a few operations per tick, but avoids the compilation of one program for each law.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.laws import ContactLaw, ContactParameters


class LawMixture(ContactLaw):
    """Contact law that applies the law `laws[parameters.kind]` to each batch element.

    Stiffness and depths have a leading axis of segments; laws without segments use the first segment. Each
    batch element has only the parameters of its own law. For the other laws, the damping is set to 0.

    If `precomputed` is true, the scenarios contain the ideal contacts of laws without a closed form
    (`Scenario.reference`). The method `ideal_contact` then returns NaN for these laws.
    """

    laws: tuple[ContactLaw, ...]
    precomputed: bool = False

    @property
    def has_closed_form(self):
        return self.precomputed or all(law.has_closed_form for law in self.laws)

    @property
    def has_memory(self):
        return any(law.has_memory for law in self.laws)

    @property
    def has_reversal_jump(self):
        return any(law.has_reversal_jump for law in self.laws)

    def init(self, penetration):
        return tuple(law.init(penetration) for law in self.laws)

    def step(self, parameters, state: Any, penetration, rate):
        results = [
            law.step(numbers, memory, penetration, rate)
            for law, numbers, memory in zip(self.laws, self._per_law(parameters), state, strict=True)
        ]
        forces, states = zip(*results, strict=True)
        return self._choose(parameters, forces), states

    def onset_force(self, parameters, rate):
        laws = zip(self.laws, self._per_law(parameters), strict=True)
        return self._choose(parameters, [law.onset_force(numbers, rate) for law, numbers in laws])

    def breakpoints(self, parameters, state: Any):
        laws = zip(self.laws, self._per_law(parameters), state, strict=True)
        return tuple(
            breakpoint for law, numbers, memory in laws for breakpoint in law.breakpoints(numbers, memory)
        )

    def separation_function(self, parameters, state: Any, penetration, rate):
        laws = zip(self.laws, self._per_law(parameters), state, strict=True)
        values = [
            law.separation_function(numbers, memory, penetration, rate) for law, numbers, memory in laws
        ]
        return self._choose(parameters, values)

    def ideal_contact(self, parameters, mass, velocity):
        unknown = IdealContact(*[jnp.full_like(velocity, jnp.nan)] * 3)
        references = [
            law.ideal_contact(numbers, mass, velocity)
            if law.has_closed_form or not self.precomputed
            else unknown
            for law, numbers in zip(self.laws, self._per_law(parameters), strict=True)
        ]
        return IdealContact(*(self._choose(parameters, leaves) for leaves in zip(*references, strict=True)))

    def _per_law(self, parameters: ContactParameters) -> list[ContactParameters]:
        """Return the parameters for each law, with damping 0 in batch elements that use a different law."""
        per_law = []
        for kind, law in enumerate(self.laws):
            damping = jnp.where(parameters.kind == kind, parameters.damping, 0)
            stiffness = parameters.stiffness if law.is_segmented else parameters.stiffness[0]
            per_law.append(parameters._replace(stiffness=stiffness, damping=damping, kind=None))
        return per_law

    def _choose(self, parameters: ContactParameters, values: Sequence[Array]) -> Array:
        chosen = jnp.asarray(values[0])
        for kind, value in enumerate(values[1:], start=1):
            chosen = jnp.where(parameters.kind == kind, value, chosen)
        return chosen
