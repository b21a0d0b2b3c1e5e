"""Derivatives of a run's results with respect to the mechanism's numbers and the gains.

Forward-mode differentiation passes through all ticks of the run. Each number has its own lane in a batch of
equal runs, and varies in that lane only.
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
from jaxhil.mechanism.overrides import KeyProblem, parse_key
from jaxhil.mechanism.structs import Mechanism, numeric_keys, value_at
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
# These results have no derivative: they are counted in ticks, or are not numbers.
NOT_DIFFERENTIABLE = ("duration", "duration_ratio", "status")
DIFFERENTIABLE_RESULTS = tuple(name for name in ContactResult._fields if name not in NOT_DIFFERENTIABLE)
_QUANTUM_KEYS = ("rig.force_sensor.quantum", "rig.position_sensor.quantum")
# At 0 the rig lacks the part that the key describes, and the results have a corner.
_KEYS_WITH_CORNER_AT_0 = ("rig.force_sensor.time_constant", "rig.force_sensor.dead_zone")
_KEY_INCREMENT = 1e-9  # added to the keys' values, so that the loop contains the parts that they switch on


class _Variable(NamedTuple):
    """Number to differentiate with respect to: a gain, or a mechanism's key, for lists one entry or all."""

    gain: str | None  # gain's name; None for a key of the mechanism
    path: str  # dotted key
    entry: tuple[int, ...]  # indices of the entry in a list; empty for all entries


def jacobian(
    mechanism: Mechanism | str | os.PathLike[str],
    compensator: str = "none",
    gains: Mapping[str, float] | str | os.PathLike[str] | None = None,
    *,
    of: str = "restitution",
    by: str | Sequence[str],
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Return d(of)/d(by) for each contact of the nominal run.

    The result has an array of shape (contacts,) for each entry of `by`, in the unit of `of` over that of the
    key. A contact that did not end normally has NaN; the derivatives of later contacts include the effect of
    all earlier ones. Mechanism, compensator, gains and seed are those of `simulate`.

    Derivatives are those of the program. A damped contact begins with a jump of the force; the change of the
    tick at which the sensor reads this jump is not included.

    Args:
        mechanism: Mechanism, name of a built-in one, or path.
        compensator: Name of the compensator.
        gains: Gains, as for `simulate`.
        of: A number of `ContactResult`, such as "restitution", "error" or "peak_force".
        by: Dotted paths of real numbers of the mechanism, such as "rig.force_sensor.delay", and "gains.NAME".
            All entries of a list vary by the same amount; "contact.stiffness[1]" is one entry.
        seed: Seed of the sensors' noise.

    Raises:
        InputError: `of` or a key is unknown, a key is not a real number or not finite, or the run is not
            differentiable with respect to it: quantisation, and delays or dead zones that are 0.

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
    keys = [_parse_variable(checked, law, path) for path in paths]
    _check_no_quantum(checked)
    check_run(checked)
    with jax_context():
        slopes, status = _compute_derivatives(
            of,
            _build_probed_loop(checked, name, keys, number),
            *_perturb_scenarios(checked, keys, values, number),
        )
    ended = np.asarray(status) == OK
    slopes = np.where(ended, np.asarray(slopes, float), np.nan)[: checked.approach.contacts]
    return {path: slopes[:, lane].copy() for lane, path in enumerate(paths)}


def _check_result(of: object, law: Compensator) -> None:
    """Raise `InputError` unless `of` is a result with a derivative."""
    names = [name for name in DIFFERENTIABLE_RESULTS if name != "force_delay" or law.estimates_delay]
    if not isinstance(of, str) or of not in names:
        hint = suggest_names(of, names) if isinstance(of, str) else ""
        raise InputError(f"of: found {format_value(of)}, expected one of {', '.join(names)}{hint}")


def _check_no_quantum(mechanism: Mechanism) -> None:
    """Raise `InputError` if a sensor quantises its readings."""
    for path in _QUANTUM_KEYS:
        if value_at(mechanism, path) != 0.0:
            allowed = "0: what is rounded has no derivative"
            raise InputError(f"{path}: found {format_value(value_at(mechanism, path))}, expected {allowed}")


def _parse_variable(mechanism: Mechanism, law: Compensator, path: object) -> _Variable:
    """Return the number that an entry of `by` names, or raise `InputError`."""
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
        raise _make_error(path, "no key to differentiate by", f"a real number{suggest_names(key, [*names])}")
    value = value_at(mechanism, key)
    if value is None or value == [] or (isinstance(value, float) and not np.isfinite(value)):
        raise _make_error(path, f"{format_value(value)} as its value", "a key with a finite value")
    if key in _KEYS_WITH_CORNER_AT_0 and value == 0.0:
        raise _make_error(path, "0 as its value", "a number > 0: there is a corner at 0")
    shape = np.shape(value)
    if len(entry) > len(shape) or any(index >= size for index, size in zip(entry, shape, strict=False)):
        raise _make_error(path, f"a value of the shape {shape}", "indices into it")
    return _Variable(None, key, entry)


def _make_error(path: object, found: str, allowed: str) -> InputError:
    """Return the error for an entry of `by`."""
    return InputError(f"by {path}: found {found}, expected {allowed}")


def _build_probed_loop(mechanism: Mechanism, compensator: str, keys: list[_Variable], seed: int) -> Loop:
    """Return the loop with all parts that the keys switch on when they are not 0."""
    scenarios = build_scenarios(
        mechanism, _build_draws(mechanism, keys, np.full(len(keys), _KEY_INCREMENT)), seed
    )
    return build_loop(mechanism, compensator, scenarios)


def _build_draws(mechanism: Mechanism, keys: list[_Variable], moved: Any) -> dict[str, Any]:
    """Return the values of all keys, a lane per key, in which this key is increased by `moved`, (keys,)."""
    # Without a key of the mechanism, this entry determines the number of lanes.
    draws: dict[str, Any] = {"approach.phase": np.full(len(keys), mechanism.approach.phase)}
    for lane, key in enumerate(keys):
        if key.gain is None:
            nominal = np.asarray(value_at(mechanism, key.path), float)
            direction = np.zeros((len(keys), *nominal.shape))
            direction[(lane, *key.entry)] = 1.0
            step = moved.reshape(-1, *[1] * nominal.ndim) * direction
            draws[key.path] = draws.get(key.path, np.broadcast_to(nominal, direction.shape)) + step
    return draws


def _perturb_scenarios(
    mechanism: Mechanism, keys: list[_Variable], gains: dict[str, float], seed: int
) -> tuple[Gains, Gains, Scenario, Scenario]:
    """Return gains and scenarios with a lane for each key, and their derivatives with respect to this key."""
    lanes = len(keys)
    values = {name: jnp.full(lanes, value) for name, value in gains.items()}
    rates = {name: jnp.array([1.0 * (key.gain == name) for key in keys]) for name in gains}

    def scenarios(moved: Array) -> Scenario:
        return build_scenarios(
            mechanism, {k: jnp.asarray(v) for k, v in _build_draws(mechanism, keys, moved).items()}, seed
        )

    batch, slopes = jax.jvp(scenarios, (jnp.zeros(lanes),), (jnp.ones(lanes),))
    # All lanes have the noise of the first one.
    batch = batch._replace(key=jnp.broadcast_to(batch.key[:, :1], batch.key.shape))
    slopes = jax.tree.map(lambda leaf, slope: slope if eqx.is_inexact_array(leaf) else None, batch, slopes)
    return values, rates, batch, slopes


@partial(jax.jit, static_argnums=(0, 1))
def _compute_derivatives(
    of: str, loop: Loop, gains: Gains, gain_rates: Gains, batch: Scenario, batch_rates: Any
) -> tuple[Array, Array]:
    """Return the derivative of the result `of` and the status of every contact, (slots, lanes)."""
    moving, fixed = eqx.partition(batch, eqx.is_inexact_array)

    def result(gains: Gains, moving: Any) -> tuple[Array, Array]:
        scenario = eqx.combine(moving, fixed)
        metrics = rollout(loop, gains, scenario)
        outcome = compare_with_ideal(loop, scenario, metrics)
        return getattr(outcome if of in Outcome._fields else metrics, of), metrics.status

    _, slopes, status = jax.jvp(result, (gains, moving), (gain_rates, batch_rates), has_aux=True)
    return slopes, status
