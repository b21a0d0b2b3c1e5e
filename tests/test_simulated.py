"""Simulations run by tuning: large compensators are compiled outside of loops with the same results."""

import re
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from cases import CASES
from lanes import spread, validated

from jaxhil.laws.none.simulation import NoCompensator
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import ONE_AXIS


class LargeLaw(NoCompensator):
    """Compensator `none` that declares a large step."""

    waits_for_contact: ClassVar[bool] = True
    is_large: ClassVar[bool] = True


def test_large_compensators_are_compiled_outside_of_loops(monkeypatch):
    monkeypatch.setattr(
        "jaxhil.simulation.one_axis.COMPENSATORS", {"none": NoCompensator(), "large": LargeLaw()}
    )
    parsed = validated(next(iter(CASES.values())).mechanism)
    scenarios = jax.tree.map(jnp.asarray, spread(parsed, 4))
    plain = build_loop(parsed, "none", scenarios)
    result, loops_left = [], []
    for name in ("none", "large"):
        loop = ONE_AXIS.with_compensator(plain, name)

        def tiles(scenarios, loop=loop):
            tiled = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), scenarios)
            return jax.lax.map(lambda one: ONE_AXIS.outcome(loop, {}, ONE_AXIS.prepared(loop, one)), tiled)

        program = jax.jit(tiles).lower(scenarios).compile()
        result.append(program(scenarios))
        text = program.as_text() or ""
        loops_left.append(len(re.findall(r" while\(", text[text.index("\nENTRY") :])))
    # The compiler turns the loop of a small compensator into a function.
    assert loops_left == [0, 1]
    for a, b in zip(*map(jax.tree.leaves, result), strict=True):
        np.testing.assert_array_equal(a, b)
