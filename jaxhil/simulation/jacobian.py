"""Derivatives of a run's results with respect to mechanism parameters and gains.

Forward-mode differentiation passes through all ticks of the run. The run is computed as a batch with one lane
per parameter. All lanes are equal, and each lane is differentiated with respect to its own parameter.
"""

import os
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxhil.errors import InputError, format_value
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Compensator, Gains
from jaxhil.mechanism.conversion import format_key_path, suggest_names
from jaxhil.mechanism.loading import as_mechanism
from jaxhil.mechanism.number_ranges import numeric_keys, value_at
from jaxhil.mechanism.overrides import KeyProblem, parse_key
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.gain_choice import choose_gains
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.outcome import Outcome, compare_with_ideal
from jaxhil.simulation.plausibility import check_run
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.run import ContactResult, check_seed
from jaxhil.simulation.scenario import Scenario, build_scenarios

GAIN_PREFIX = "gains."
# Results without a derivative: durations are whole numbers of ticks, and the status is a string.
NOT_DIFFERENTIABLE = ("duration", "duration_ratio", "status")
DIFFERENTIABLE_RESULTS = tuple(name for name in ContactResult._fields if name not in NOT_DIFFERENTIABLE)
_QUANTUM_KEYS = ("rig.force_sensor.quantum", "rig.position_sensor.quantum")
# Keys whose value must not be 0: at 0 the rig does not have the effect, and the derivative is one-sided.
_KEYS_WITH_CORNER_AT_0 = ("rig.force_sensor.time_constant", "rig.force_sensor.dead_zone")
# The loop is built for values that are larger by this increment, so that it includes effects of the value 0.
_KEY_INCREMENT = 1e-9


class _Variable(NamedTuple):
    """Independent variable of a derivative: a gain, or a parameter of the mechanism."""

    gain: str | None  # name of the gain; None for a parameter of the mechanism
    path: str  # dotted path of the parameter; empty for a gain
    entry: tuple[int, ...]  # indices of one entry of a list; empty for all entries together


def jacobian(
    mechanism: Mechanism | str | os.PathLike[str],
    compensator: str = "none",
    gains: Mapping[str, float] | str | os.PathLike[str] | None = None,
    *,
    of: str = "restitution",
    by: str | Sequence[str],
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Return the derivative d(of)/d(by) for each contact of the nominal run.

    The derivative for a contact includes the effect of `by` on all earlier contacts. A contact that did not
    end normally has the derivative NaN.

    The derivative is exact, with one exception: a damped contact begins with a jump of the force, and the
    tick at which the sensor reads this jump is assumed to be constant.

    Args:
        mechanism: Mechanism, name of a built-in mechanism, or path of a mechanism file.
        compensator: Name of the compensator.
        gains: Gains, as for `simulate`.
        of: Name of a numeric field of `ContactResult`, such as "restitution", "error" or "peak_force".
        by: One or several parameters: dotted paths of real numbers in the mechanism, such as
            "rig.force_sensor.delay", or "gains.NAME". If the parameter is a list, all its entries vary by the
            same amount; "contact.stiffness[1]" varies one entry only.
        seed: Seed of the sensors' noise.

    Returns:
        Dict: for each entry of `by`, an array (contacts,), in the unit of `of` divided by the entry's unit.

    Raises:
        InputError: `of` or an entry of `by` is unknown; a parameter is not a finite real number; or the run
            is not differentiable, because a sensor quantises its readings, or because `by` contains the
            force sensor's dead zone or time constant, and this parameter is 0.

    Example:
        >>> import jaxhil
        >>> slopes = jaxhil.jacobian("rig-300kg", by="rig.force_sensor.delay")
        >>> slopes["rig.force_sensor.delay"].shape
        (1,)
    """
    checked = as_mechanism(mechanism)
    number = check_seed(seed)
    name, values = choose_gains(checked, compensator, gains)
    law = COMPENSATORS[name]
    _check_result(of, law)
    paths = [by] if isinstance(by, str) else by
    if not isinstance(paths, Sequence) or isinstance(paths, bytes) or not paths:
        allowed = "dotted paths, such as ['rig.force_sensor.delay', 'gains.phase_lead']"
        raise InputError(f"by: found {format_value(by)}, expected {allowed}")
    variables = [_parse_variable(checked, law, path) for path in paths]
    _check_no_quantum(checked)
    check_run(checked)
    with jax_context():
        slopes, status = _compute_derivatives(
            of,
            _build_complete_loop(checked, name, variables, number),
            *_perturb_scenarios(checked, variables, values, number),
        )
    ended = np.asarray(status) == OK
    slopes = np.where(ended, np.asarray(slopes, float), np.nan)[: checked.approach.contacts]
    return {path: slopes[:, lane].copy() for lane, path in enumerate(paths)}


def _check_result(of: object, law: Compensator) -> None:
    """Raise `InputError` unless `of` names a differentiable field of `ContactResult`."""
    names = [name for name in DIFFERENTIABLE_RESULTS if name != "force_delay" or law.estimates_delay]
    if not isinstance(of, str) or of not in names:
        hint = suggest_names(of, names) if isinstance(of, str) else ""
        raise InputError(f"of: found {format_value(of)}, expected one of {', '.join(names)}{hint}")


def _check_no_quantum(mechanism: Mechanism) -> None:
    for path in _QUANTUM_KEYS:
        if value_at(mechanism, path) != 0.0:
            allowed = "0: quantised readings have no derivative"
            raise InputError(f"{path}: found {format_value(value_at(mechanism, path))}, expected {allowed}")


def _parse_variable(mechanism: Mechanism, law: Compensator, path: object) -> _Variable:
    """Return the variable with this `path`; raise `InputError` if it has no derivative."""
    if isinstance(path, str) and path.startswith(GAIN_PREFIX):
        gain, names = path.removeprefix(GAIN_PREFIX), [gain.name for gain in law.gains]
        if gain not in names:
            allowed = ", ".join(GAIN_PREFIX + name for name in names) or f"no gain: {law.name} has none"
            raise InputError(
                f"by: found {format_value(path)}, expected {allowed}{suggest_names(gain, names)}"
            )
        return _Variable(gain, "", ())
    try:
        parts = parse_key(path)
    except KeyProblem:
        raise InputError(
            f"by: found {format_value(path)}, expected a dotted path of the mechanism, or gains.NAME"
        ) from None
    entry = tuple(part for part in parts if isinstance(part, int))
    key = format_key_path(parts[: len(parts) - len(entry)])
    if key not in numeric_keys() or key in _QUANTUM_KEYS:
        names = [k for k in numeric_keys() if not k.startswith("uncertainty") and k not in _QUANTUM_KEYS]
        allowed = f"the path of a real number{suggest_names(key, [*names])}"
        raise _make_error(path, "a path without a derivative", allowed)
    value = value_at(mechanism, key)
    if value is None or value == [] or (isinstance(value, float) and not np.isfinite(value)):
        raise _make_error(path, format_value(value), "a key with a finite value")
    if key in _KEYS_WITH_CORNER_AT_0 and value == 0.0:
        raise _make_error(path, "0", "a value > 0: the derivative at 0 is one-sided")
    shape = np.shape(value)
    if len(entry) > len(shape) or any(index >= size for index, size in zip(entry, shape, strict=False)):
        raise _make_error(path, f"indices outside the shape {shape} of the value", "indices within it")
    return _Variable(None, key, entry)


def _make_error(path: object, found: str, allowed: str) -> InputError:
    """Return the error with the message "by PATH: found ..., expected ..."."""
    return InputError(f"by {path}: found {found}, expected {allowed}")


def _build_complete_loop(
    mechanism: Mechanism, compensator: str, variables: list[_Variable], seed: int
) -> Loop:
    """Return a loop that includes every effect whose parameter is differentiated, even if its value is 0."""
    scenarios = build_scenarios(
        mechanism, _build_draws(mechanism, variables, np.full(len(variables), _KEY_INCREMENT)), seed
    )
    return build_loop(mechanism, compensator, scenarios)


def _build_draws(mechanism: Mechanism, variables: list[_Variable], increments: Any) -> dict[str, Any]:
    """Return the parameters' values by dotted path, as a batch with one lane per variable.

    In lane i, variable i has its nominal value plus `increments[i]`; all other values are nominal.
    """
    # If all variables are gains, the phase is the only draw, and determines the number of lanes.
    draws: dict[str, Any] = {"approach.phase": np.full(len(variables), mechanism.approach.phase)}
    for lane, variable in enumerate(variables):
        if variable.gain is None:
            nominal = np.asarray(value_at(mechanism, variable.path), float)
            direction = np.zeros((len(variables), *nominal.shape))
            direction[(lane, *variable.entry)] = 1.0
            step = increments.reshape(-1, *[1] * nominal.ndim) * direction
            draws[variable.path] = draws.get(variable.path, np.broadcast_to(nominal, direction.shape)) + step
    return draws


def _perturb_scenarios(
    mechanism: Mechanism, variables: list[_Variable], gains: dict[str, float], seed: int
) -> tuple[Gains, Gains, Scenario, Scenario]:
    """Return gains and their derivatives, then scenarios and their derivatives, one lane per variable.

    Lane i contains the derivatives with respect to variable i.
    """
    lanes = len(variables)
    values = {name: jnp.full(lanes, value) for name, value in gains.items()}
    rates = {name: jnp.array([1.0 * (variable.gain == name) for variable in variables]) for name in gains}

    def scenarios(increments: Array) -> Scenario:
        return build_scenarios(
            mechanism,
            {k: jnp.asarray(v) for k, v in _build_draws(mechanism, variables, increments).items()},
            seed,
        )

    batch, slopes = jax.jvp(scenarios, (jnp.zeros(lanes),), (jnp.ones(lanes),))
    # All lanes have the sensor noise of the first lane.
    batch = batch._replace(key=jnp.broadcast_to(batch.key[:, :1], batch.key.shape))
    slopes = jax.tree.map(lambda leaf, slope: slope if eqx.is_inexact_array(leaf) else None, batch, slopes)
    return values, rates, batch, slopes


@partial(jax.jit, static_argnums=(0, 1))
def _compute_derivatives(
    of: str, loop: Loop, gains: Gains, gain_rates: Gains, batch: Scenario, batch_rates: Any
) -> tuple[Array, Array]:
    """Return the derivative of the result named `of`, and the status, for every contact, (contacts, lanes).

    `gain_rates` and `batch_rates` are the inputs' derivatives with respect to the variable of each lane.
    """
    moving, fixed = eqx.partition(batch, eqx.is_inexact_array)

    def result(gains: Gains, moving: Any) -> tuple[Array, Array]:
        scenario = eqx.combine(moving, fixed)
        metrics = rollout(loop, gains, scenario)
        outcome = compare_with_ideal(loop, scenario, metrics)
        return getattr(outcome if of in Outcome._fields else metrics, of), metrics.status

    _, slopes, status = jax.jvp(result, (gains, moving), (gain_rates, batch_rates), has_aux=True)
    return slopes, status
