"""Excess variation of the command for sequences with known swings, including onset and end of a contact.

The mechanism is in contact with a given command at every tick, and the recorded value is compared with an
explicit sum. Simulated contacts are compared with the oracle in test_rollout.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK, first_contact, join, mechanism, nominal_gains, spread, validated

from jaxhil.laws.simulation_base import Signals
from jaxhil.simulation.contact_force import PlantSignals
from jaxhil.simulation.contact_tracking import build_end_conditions, record_contact, start_tracking
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import empty_metrics, store_metrics
from jaxhil.simulation.scenario import build_scenarios

PARSED = validated(mechanism({}))
SCENARIO = join([build_scenarios(PARSED)])
LOOP = build_loop(PARSED, "none", SCENARIO, chatter=True)
BEFORE, AFTER = 5, 40  # ticks without force


@partial(jax.jit, compiler_options=QUICK)
def excess(commands, touching):
    """Return the excess variation [N] of commands (ticks,), with or without contact."""
    rules = build_end_conditions(SCENARIO)
    zeros = jnp.zeros(1)

    def tick(tracker, now):
        command, touches = now
        # The model reverses immediately, so that the contact ends during the ticks without force.
        signals = Signals(zeros, zeros, zeros - 1, zeros, jnp.zeros(1, jnp.int32))
        plant_signals = PlantSignals(jnp.where(touches, 10.0, 0.0)[None], None, None, None)
        return record_contact(LOOP, rules, tracker, signals, plant_signals, command[None], None), None

    tracker, _ = jax.lax.scan(tick, start_tracking(LOOP, zeros), (commands, touching))
    index = jnp.zeros(1, jnp.int32)
    metrics = store_metrics(
        SCENARIO, empty_metrics(LOOP, 4, zeros), tracker, index, tracker.has_ended, index, index
    )
    return metrics.excess_variation[0, 0]


def recorded(commands, after=()):
    """Return the excess variation of a contact with these commands; `after` holds commands after its end."""
    quiet = np.zeros(AFTER)
    late = AFTER - len(after)
    quiet[late:] = after
    padded = np.concatenate([np.zeros(BEFORE), commands, quiet])
    touching = np.concatenate([np.zeros(BEFORE, bool), np.ones(len(commands), bool), np.zeros(AFTER, bool)])
    pad = 400 - len(padded)
    return float(excess(np.pad(padded, (0, pad)), np.pad(touching, (0, pad))))


HUMP = 60 * np.sin(np.linspace(0, np.pi, 101))


@pytest.mark.parametrize(
    "commands, expected",
    [
        (HUMP, 0),
        (-HUMP, 0),
        # An undershoot is part of the swing, wherever it is.
        (np.concatenate([HUMP, -0.2 * HUMP]), 0),
        (np.concatenate([-0.2 * HUMP, HUMP]), 0),
        # Each further maximum adds a swing.
        (np.concatenate([HUMP, HUMP]), 60),
        (np.concatenate([HUMP, 0.25 * HUMP, HUMP]), 75),
        # A spike of ten times the peak is the regular swing; the following hump counts as excess.
        (np.concatenate([[600], HUMP]), 60),
        (np.concatenate([[600, -200], HUMP]), 60),
        # Ripple of 2 N on a plateau of 60 N: 20 rises, one of which belongs to the regular swing.
        (60 + np.tile([0, 2], 20), 2 * 19),
        # Limit cycle: ten swings through the whole range of 100 N.
        (np.tile([50, -50], 10), 9 * 100),
    ],
)
def test_excess_variation_of_known_command_sequences_is_exact(commands, expected):
    assert recorded(commands) == pytest.approx(expected, abs=1e-11)


def test_excess_variation_equals_sum_computed_by_hand():
    commands = 60 * np.random.default_rng(0).normal(size=200)
    path = np.array([0, *commands, 0])
    assert recorded(commands) == pytest.approx(np.abs(np.diff(path)).sum() / 2 - np.ptp(path), rel=1e-13)


def test_excess_variation_ignores_commands_after_the_contact():
    assert recorded(HUMP, after=[70, -70, 70]) == pytest.approx(0, abs=1e-11)


def test_excess_variation_counts_return_of_the_last_command_to_zero():
    """Half of the undershoot remains when the wait for the decay of the command ends."""
    commands = np.concatenate([HUMP, np.full(120, -10.0)])
    touching = np.zeros(400, bool)
    touching[BEFORE : BEFORE + len(HUMP)] = True
    padded = np.pad(commands, (BEFORE, 400 - BEFORE - len(commands)))
    assert float(excess(padded, touching)) == pytest.approx(0, abs=1e-11)


def test_excess_variation_derivatives_equal_derivatives_of_explicit_sum():
    generator = np.random.default_rng(1)
    touching = (np.arange(400) >= BEFORE) & (np.arange(400) < BEFORE + len(HUMP))
    commands, way = np.zeros((2, 400))
    commands[touching] = HUMP + generator.normal(size=len(HUMP))
    way[touching] = generator.normal(size=len(HUMP))

    def slope(commands):
        return jax.jvp(lambda commands: excess(commands, touching), (commands,), (way,))[1]

    up, down = (float(excess(commands + step * way, touching)) for step in (1e-6, -1e-6))
    assert float(slope(commands)) == pytest.approx((up - down) / 2e-6, rel=1e-7)
    # If the command is constant, neither direction is preferred.
    assert np.isfinite(slope(np.where(touching, 60.0, 0.0)))


def test_commands_of_compensators_without_identification_have_no_excess_variation():
    """The undershoot of a phase lead belongs to its only swing."""
    for compensator, gains in (("none", {}), ("phase_lead", nominal_gains(PARSED, "phase_lead"))):
        recorded = first_contact(PARSED, spread(PARSED, 1), compensator, gains, chatter=True)
        assert recorded["excess_variation"] == pytest.approx(0, abs=1e-11 * recorded["peak_command"][0])
