"""Knowledge in addition to the logs: specified parameters and the normal marginals of a prior.

The logs give draws with mean m and covariance C. The additional knowledge that H theta is normal with mean p
and covariance P moves draw i by

    K (p_i - H theta_i),    K = C H^T (H C H^T + P)^-1,

where p_i is a draw of the additional knowledge (Matheron's rule, a Kalman update of each draw). This is exact
for normal draws; a specified parameter has P = 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from jaxhil.errors import InputError, to_one_line
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from tuning.identification import mechanism_models

DrawsByKey = dict[str, np.ndarray]

CONTRADICTION_SIGMAS = 4.0  # standard deviations between a specified value and the logs that cause a note
FORCE_DELAY_KEY, SIMULATOR_PREFIX = "rig.force_sensor.delay", "rig.simulator."


def split_lists(fixed: Mapping[str, Any], found: Sequence[str]) -> dict[str, float]:
    """Return the specified parameters by key, with lists split into entries.

    A scalar for a list applies to each of its entries.

    Raises:
        InputError: If the logs do not determine a key, or a list has another length.
    """
    values_by_key: dict[str, float] = {}
    for key, value in fixed.items():
        entries = [name for name in found if name == key or name.startswith(f"{key}.")]
        values = _flatten(key, value)
        if isinstance(value, (int, float)):
            values = dict.fromkeys(entries, float(value))
        unknown = [name for name in values if name not in found]
        if not values or unknown:
            allowed = ", ".join(found) or "nothing: these logs tell no number"
            raise InputError(f"fix: found {to_one_line((*unknown, key)[0], 60)}, expected {allowed}")
        values_by_key |= values
    return values_by_key


def _flatten(key: str, value: Any) -> dict[str, float]:
    if isinstance(value, (list, tuple)):
        return {k: v for i, item in enumerate(value) for k, v in _flatten(f"{key}.{i}", item).items()}
    return {key: float(value)}


def condition_on_fixed(found: DrawsByKey, told: Mapping[str, float]) -> tuple[DrawsByKey, list[str]]:
    """Condition the draws on specified parameters.

    Returns:
        The draws of the other parameters, and a note for each value that contradicts the logs.
    """
    if not told:
        return found, []
    keys, indices = list(found), [list(found).index(key) for key in told]
    notes = []
    for key, value in told.items():
        mean, std = found[key].mean(), found[key].std(ddof=1)
        if abs(value - mean) > CONTRADICTION_SIGMAS * std:
            notes.append(f"{key}: {value:g} was told, the logs say {mean:.5g} +- {std:.2g}")
    values = np.broadcast_to(np.array(list(told.values())), (len(next(iter(found.values()))), len(told)))
    moved = _update_draws(np.array(list(found.values())), np.eye(len(keys))[indices], values.T, exact=True)
    return {key: row for key, row in zip(keys, moved, strict=True) if key not in told}, notes


def condition_on_prior(found: DrawsByKey, prior: Mechanism, frequency: float, seed: int = 0) -> DrawsByKey:
    """Combine the draws with the prior's normal marginals and their correlation.

    The result includes parameters of the simulator and of the prior's correlation that the logs do not
    determine.

    Args:
        found: Draws from the logs, by key.
        prior: Mechanism with `[uncertainty]`.
        frequency: Contact frequency [Hz]; an error of the simulator's lag there changes the force delay.
        seed: Seed of the random numbers.

    Raises:
        InputError: If no parameter of the logs has a normal marginal.
    """
    marginals = _draw_normal_marginals(prior, len(next(iter(found.values()), ())), seed)
    common = [key for key in marginals if key in found]
    if not common:
        allowed = f"a normal one of {', '.join(found) or 'what logs tell'}"
        raise InputError(f"prior: [uncertainty]: found no entry of what the logs tell, expected {allowed}")
    linked = () if prior.correlation is None else prior.correlation.keys
    prior_only = [
        key
        for key in marginals
        if key not in found and (key.startswith(SIMULATOR_PREFIX) or key.rstrip("0123456789.") in linked)
    ]
    extended = {**found, **{key: marginals[key] for key in prior_only}}
    if FORCE_DELAY_KEY in found:
        lag = _differentiate_lag(
            prior, [key for key in prior_only if key.startswith(SIMULATOR_PREFIX)], frequency
        )
        lag_changes = [slope * (marginals[key] - marginals[key].mean()) for key, slope in lag.items()]
        extended[FORCE_DELAY_KEY] = found[FORCE_DELAY_KEY] - sum(lag_changes, np.zeros(1))
    keys = list(extended)
    select = np.zeros((len(common), len(keys)))
    select[np.arange(len(common)), [keys.index(key) for key in common]] = 1.0
    values = np.array([marginals[key] for key in common])
    if prior_only:
        # Condition the marginals on the parameters that only the prior has.
        beside = np.array([marginals[key] for key in prior_only])
        covariance, split = np.cov(values, beside), len(common)
        follow = covariance[:split, split:] @ _invert_scaled(covariance[split:, split:])
        select[:, [keys.index(key) for key in prior_only]] = -follow
        values = values - follow @ beside
    moved = _update_draws(np.array(list(extended.values())), select, values)
    result = dict(zip(keys, moved, strict=True))
    return {k: np.maximum(v, 0.0) if k.startswith("contact.damping") else v for k, v in result.items()}


def _update_draws(
    draws: np.ndarray, select: np.ndarray, values: np.ndarray, exact: bool = False
) -> np.ndarray:
    """Return draws (keys, draws), updated by `values` (rows, draws) of `select` times the draws."""
    covariance = np.atleast_2d(np.cov(draws))
    across = covariance @ select.T
    spread = np.zeros((len(select), len(select))) if exact else np.atleast_2d(np.cov(values))
    return draws + across @ _invert_scaled(select @ across + spread) @ (values - select @ draws)


def _invert_scaled(covariance: np.ndarray) -> np.ndarray:
    """Return the pseudoinverse of a covariance of possibly dependent parameters in different units."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(
        scale, scale
    )


def _draw_normal_marginals(prior: Mechanism, number: int, seed: int) -> DrawsByKey:
    """Return draws of the prior's parameters with a normal marginal, with lists split into entries."""
    normal = {key for key, entry in prior.uncertainty.items() if entry.distribution == "normal"}
    result: DrawsByKey = {}
    for key, values in draw(prior, number, seed).items():
        if key in normal:
            for index in np.ndindex(values.shape[1:]):
                result[".".join([key, *map(str, index)])] = values[(slice(None), *index)]
    return result


def _differentiate_lag(prior: Mechanism, keys: Sequence[str], frequency: float) -> dict[str, float]:
    """Return the motion lag's derivative at a frequency [Hz] by each simulator parameter [s per unit]."""
    simulator = prior.rig.simulator
    s = np.array([2j * np.pi * frequency])

    def lag(name: str, value: float) -> float:
        moved = msgspec.structs.replace(simulator, **{name: value})
        rig = msgspec.structs.replace(prior.rig, simulator=moved)
        model = mechanism_models.make_motion_model(msgspec.structs.replace(prior, rig=rig))
        return -float(np.angle(model.response(s)[0])) / (2.0 * np.pi * frequency)

    slopes = {}
    for key in keys:
        name = key.removeprefix(SIMULATOR_PREFIX)
        value = getattr(simulator, name, None)
        if isinstance(value, float) and value:
            slopes[key] = (lag(name, 1.0001 * value) - lag(name, 0.9999 * value)) / (0.0002 * value)
    return slopes
