"""Batches of runs in six axes as those on one axis are: on every core, with an outcome of the same form.

Importing this teaches `jaxhil.simulation.evaluation` scenarios and loops of six axes. An episode has two
errors; both are rows of the outcome, those of the energy before those of the twist.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.simulation import metrics as one_axis
from jaxhil.simulation.contact_bounds import unlike_ideal
from jaxhil.simulation.environment import SIX_AXES
from jaxhil.simulation.evaluation import (
    Outcome,
    at_rest,
    compiler_options,
    expected_duration,
    run_lanes,
    whole_delays,
)
from jaxhil.sixdof.loop import Loop
from jaxhil.sixdof.metrics import Metrics, evaluate
from jaxhil.sixdof.rollout import CAPTURED, JAMMED, MISS, NON_FINITE, REBOUNDED, TIMEOUT
from jaxhil.sixdof.scenario import Scenario

ERRORS = ("energy_error", "twist_error")  # of an episode, in the order of an outcome's rows
# What a status is on one axis; whatever is not here diverged.
STATUSES = {
    MISS: one_axis.NOT_REACHED,
    REBOUNDED: one_axis.OK,
    CAPTURED: one_axis.OK,
    JAMMED: one_axis.TIMEOUT,
    TIMEOUT: one_axis.TIMEOUT,
    NON_FINITE: one_axis.NON_FINITE,
}


@run_lanes.register
def run_in_space(loop: Loop, gains: Any, scenario: Scenario) -> Outcome:
    """Outcome of lanes, rows (errors of the energy, then of the twist; *batch)."""
    return outcome_of(evaluate(loop, gains, scenario).metrics, scenario)


@compiler_options.register
def options_in_space(loop: Loop) -> Mapping[str, int | str]:
    """Options of the compiler for batches in six axes."""
    return SIX_AXES


@at_rest.register
def at_rest_in_space(scenarios: Scenario, idle: np.ndarray) -> Scenario:
    """Scenarios of which the `idle` lanes do nothing."""
    duration: Any = np.where(idle, 0.0, scenarios.duration).astype(np.asarray(scenarios.duration).dtype)
    return scenarios._replace(duration=duration)


@expected_duration.register
def expected_duration_in_space(scenarios: Scenario) -> np.ndarray:
    """All the same: nothing is known beforehand."""
    return np.zeros(np.shape(scenarios.duration))


@whole_delays.register
def whole_delays_in_space(scenarios: Scenario) -> np.ndarray:
    """All the same: lanes are read one by one."""
    return np.zeros(np.shape(scenarios.duration))


def outcome_of(found: Metrics, scenario: Scenario) -> Outcome:
    """Figures of episodes as an outcome; its peaks are those of the real force, and no chatter is known."""
    # A draw that goes past the target, or never comes, has no contact to judge.
    begins = jnp.isfinite(scenario.start.chaser.position.z)
    wanted = (found.status != MISS) & begins[None]
    known = jnp.isfinite(found.energy_error) & jnp.isfinite(found.twist_error)
    status = jnp.full_like(found.status, one_axis.DIVERGED)
    for own, meant in STATUSES.items():
        status = jnp.where(found.status == own, meant, status)
    status = jnp.where(wanted, jnp.where((status == one_axis.OK) & ~known, one_axis.NON_FINITE, status),
                       one_axis.NOT_REACHED)  # fmt: skip
    zero = jnp.zeros_like(found.energy_error)
    metrics = one_axis.Metrics(
        restitution=found.restitution,
        approach_velocity=found.approach_velocity,
        peak_force=found.peak_force,
        peak_command=found.peak_force,
        excess_variation=zero,
        position_shortfall=zero,
        duration=found.duration,
        work_in=zero,
        work_out=zero,
        trajectory_error=zero,
        force_delay=zero,
        status=status,
        ticks=0 * status,
    )
    ratio = found.peak_force / jnp.where(found.reference_peak_force > 0, found.reference_peak_force, jnp.nan)
    both = Outcome(
        metrics=metrics,
        reference_restitution=found.reference_restitution,
        reference_peak_force=found.reference_peak_force,
        reference_duration=found.reference_duration,
        error=found.energy_error,
        peak_ratio=ratio,
        chatter=zero,
        wanted=wanted,
        good=status == one_axis.OK,
        unlike=(status == one_axis.OK)
        & unlike_ideal(
            found.peak_force,
            found.reference_peak_force,
            found.duration,
            found.reference_duration,
            scenario.control_period[None],
        ),
    )
    rows: Outcome = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), both)
    return rows._replace(error=jnp.concatenate([found.energy_error, found.twist_error]))
