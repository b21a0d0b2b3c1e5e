"""Transparency of the six-axis impulse ledger: response to a push that its contact model does not contain.

A push of 20 ms acts on the chaser's origin during the contact. The ideal rig, without lag, delay and noise,
shows the change of the final twist that the push should cause.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import QUICK
from six_axis_ranges import WIDE, load_wide

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.loop import begin, build_rig_constants, complete_tick, integrate
from jaxhil.sixdof.metrics import evaluate
from jaxhil.sixdof.sensing import sense

pytestmark = pytest.mark.slow
NAME, LAW, LANES, TICKS = "probe-drogue", "impulse_ledger", 64, 700
DURATION, SIZE = 0.02, 0.2  # peak of the push divided by the ideal contact's peak force [s]
IDEAL = {
    "uncertainty": {}, "rig.simulator": {"model": "ideal"}, "rig.force_sensor": {"delay": 0.0},
    "rig.position_sensor": {},
}  # fmt: skip


def final_twist(loop, gains, scenario, force, middle):
    """Return the model's final twist (6, lanes) after a half-sine push with the peak `force` (3, lanes) [N].

    The middle of the push is `middle` [s] after the first touch of the hardware.
    """
    rig, law = build_rig_constants(loop, gains, scenario), SIX_AXIS_COMPENSATORS[loop.compensator]

    def tick(carry, _):
        state, touched = carry
        sensed = sense(loop, rig, state)
        touches = (touched > 0) | (sensed.forces[0].touch.depth[0] > 0)
        touched = touched + touches.astype(jnp.int32)
        phase = (touched.astype(rig.period.dtype) * rig.period - middle) / DURATION + 0.5
        shape = jnp.where((phase > 0) & (phase < 1), jnp.sin(jnp.pi * phase), 0)
        push = shape[None] * force
        position = jnp.stack(jax.tree.leaves(sensed.motion.pose.position))
        moment = jnp.cross(position, push, axis=0)
        wrench = jnp.stack(sensed.signals.wrench) + jnp.concatenate([push, moment])
        signals = sensed.signals._replace(wrench=tuple(wrench))
        commands, law_state = law.step(rig.prepared, state.controller.law, signals, state.tick)
        command = jax.tree.unflatten(jax.tree.structure(sensed.contact), commands)
        states, position, rates, twist = integrate(loop, rig, state, command)
        sent = law.pose_command(rig.gains, position, rates)
        after, _ = complete_tick(loop, rig, state, sensed, command, (states, position, twist), sent)
        return (after._replace(controller=after.controller._replace(law=law_state)), touched), None

    start = begin(loop, rig, scenario.start), jnp.zeros(LANES, jnp.int32)
    (state, _), _ = jax.lax.scan(tick, start, None, length=TICKS)
    return state.twist


def test_push_during_a_contact_changes_the_twist_as_in_the_ideal_contact():
    """Compare pushes at 25 and 75 % of the contact, along the normal and perpendicular to it."""
    mechanism, ideal = load_wide(NAME), load_any(WIDE / f"{NAME}.toml", IDEAL).mechanism
    draws = draw(mechanism, LANES, 7)
    of_contact = {key: value for key, value in draws.items() if not key.startswith("rig.")}
    with jax_context():
        rig = build_scenarios(mechanism, draws, seed=7)
        perfect = build_scenarios(ideal, of_contact, seed=7)
        runs = [
            (make_loop(model, law, scenario), literature_gains(model, law), scenario)
            for model, law, scenario in ((mechanism, LAW, rig), (ideal, "none", perfect))
        ]
        runs = [(loop, {k: jnp.asarray(v) for k, v in gains.items()}, sc) for loop, gains, sc in runs]
        metrics = jax.jit(evaluate, static_argnums=0, compiler_options=QUICK)(*runs[0]).metrics
        mass = np.asarray(build_rig_constants(*runs[0]).constants.mass_matrix)
        program = jax.jit(final_twist, static_argnums=0, compiler_options=QUICK)
        normal = np.asarray(metrics.normal)[:, 0]
        across = np.cross(normal, [0.0, 1.0, 0.0], axis=0)
        directions = {"along": normal, "across": across / np.linalg.norm(across, axis=0)}
        still = [np.asarray(program(*run, jnp.zeros((3, LANES)), jnp.zeros(LANES))) for run in runs]
        for name, direction in directions.items():
            for share in (0.25, 0.75):
                force = SIZE * np.asarray(metrics.reference_peak_force[0]) * direction
                middle = share * np.asarray(metrics.reference_duration[0])
                pushed = [program(*run, jnp.asarray(force), jnp.asarray(middle)) for run in runs]
                change, expected = (np.asarray(a) - b for a, b in zip(pushed, still, strict=True))
                product = np.einsum("il,ijl,jl->l", change, mass, expected)
                square = np.einsum("il,ijl,jl->l", expected, mass, expected)
                transparency = np.median(product / square)
                print(f"{name}, {100 * share:.0f} %: {transparency:.3f}")
                assert transparency >= {"along": 0.7, "across": 0.8}[name]
