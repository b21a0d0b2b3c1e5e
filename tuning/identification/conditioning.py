"""Combination of the logs with further knowledge: fixed parameters, and a prior's normal distributions.

The logs give draws theta_i of the parameters, with the covariance C. Assume that H theta is also known to be
normal with mean p and covariance P. This knowledge moves each draw theta_i by

    K (p_i - H theta_i),    K = C H^T (H C H^T + P)^-1,

where p_i is drawn from this known normal distribution (Matheron's rule, a Kalman update of each draw). The
result is exact for normal draws. A fixed parameter has P = 0.
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

CONTRADICTION_SIGMAS = 4.0  # maximum distance of a fixed value from the estimate without a note, in std
FORCE_DELAY_KEY, SIMULATOR_PREFIX = "rig.force_sensor.delay", "rig.simulator."


def split_lists(fixed: Mapping[str, Any], keys: Sequence[str]) -> dict[str, float]:
    """Return the values of the fixed parameters, with one key per list entry.

    A scalar value of a list parameter applies to every entry of the list.

    Args:
        fixed: Fixed values by key; the value of a list parameter may be a list or a scalar.
        keys: Keys of the parameters that the logs determine.

    Raises:
        InputError: If the logs do not determine a fixed parameter, or a list has the wrong length.
    """
    values_by_key: dict[str, float] = {}
    for key, value in fixed.items():
        entries = [name for name in keys if name == key or name.startswith(f"{key}.")]
        values = _flatten(key, value)
        if isinstance(value, (int, float)):
            values = dict.fromkeys(entries, float(value))
        unknown = [name for name in values if name not in keys]
        if not values or unknown:
            expected = ", ".join(keys) or "no key: these logs determine no parameter"
            raise InputError(f"fix: found {to_one_line((*unknown, key)[0], 60)}, expected {expected}")
        values_by_key |= values
    return values_by_key


def _flatten(key: str, value: Any) -> dict[str, float]:
    if isinstance(value, (list, tuple)):
        return {k: v for i, item in enumerate(value) for k, v in _flatten(f"{key}.{i}", item).items()}
    return {key: float(value)}


def condition_on_fixed(draws: DrawsByKey, fixed: Mapping[str, float]) -> tuple[DrawsByKey, list[str]]:
    """Condition posterior draws on fixed parameters.

    Returns:
        The draws of the parameters that are not fixed, and a note for each fixed value that contradicts the
        logs.
    """
    if not fixed:
        return draws, []
    keys, indices = list(draws), [list(draws).index(key) for key in fixed]
    notes = []
    for key, value in fixed.items():
        mean, std = draws[key].mean(), draws[key].std(ddof=1)
        if abs(value - mean) > CONTRADICTION_SIGMAS * std:
            notes.append(f"{key}: fixed at {value:g}, but the logs give {mean:.5g} +- {std:.2g}")
    values = np.broadcast_to(np.array(list(fixed.values())), (len(next(iter(draws.values()))), len(fixed)))
    moved = _update_draws(np.array(list(draws.values())), np.eye(len(keys))[indices], values.T, exact=True)
    return {key: row for key, row in zip(keys, moved, strict=True) if key not in fixed}, notes


def condition_on_prior(draws: DrawsByKey, prior: Mechanism, frequency: float, seed: int = 0) -> DrawsByKey:
    """Combine posterior draws with a prior's normal distributions and their correlation.

    The result also contains parameters that only the prior determines: those of the simulator, and those in
    the prior's `[correlation]`.

    Args:
        draws: Draws from the logs, by key.
        prior: Mechanism with the table `[uncertainty]`.
        frequency: Contact frequency [Hz]. An error of the simulator's phase delay at this frequency changes
            the estimated force delay.
        seed: Seed of the random numbers.

    Raises:
        InputError: If the prior has no normal distribution for any parameter that the logs determine.
    """
    marginals = _draw_normal_marginals(prior, len(next(iter(draws.values()), ())), seed)
    common = [key for key in marginals if key in draws]
    if not common:
        expected = ", ".join(draws) or "logs that determine a parameter"
        raise InputError(
            "prior: [uncertainty]: found no normal distribution of a parameter that the logs determine, "
            f"expected one of {expected}"
        )
    linked = () if prior.correlation is None else prior.correlation.keys
    prior_only = [
        key
        for key in marginals
        if key not in draws and (key.startswith(SIMULATOR_PREFIX) or key.rstrip("0123456789.") in linked)
    ]
    extended = {**draws, **{key: marginals[key] for key in prior_only}}
    if FORCE_DELAY_KEY in draws:
        lag = _differentiate_lag(
            prior, [key for key in prior_only if key.startswith(SIMULATOR_PREFIX)], frequency
        )
        lag_changes = [slope * (marginals[key] - marginals[key].mean()) for key, slope in lag.items()]
        extended[FORCE_DELAY_KEY] = draws[FORCE_DELAY_KEY] - sum(lag_changes, np.zeros(1))
    keys = list(extended)
    select = np.zeros((len(common), len(keys)))
    select[np.arange(len(common)), [keys.index(key) for key in common]] = 1.0
    values = np.array([marginals[key] for key in common])
    if prior_only:
        # The prior correlates these parameters with others that only the prior determines: use the residuals
        # of a linear regression on the others.
        prior_values = np.array([marginals[key] for key in prior_only])
        covariance, split = np.cov(values, prior_values), len(common)
        follow = covariance[:split, split:] @ _invert_scaled(covariance[split:, split:])
        select[:, [keys.index(key) for key in prior_only]] = -follow
        values = values - follow @ prior_values
    moved = _update_draws(np.array(list(extended.values())), select, values)
    result = dict(zip(keys, moved, strict=True))
    return {k: np.maximum(v, 0.0) if k.startswith("contact.damping") else v for k, v in result.items()}


def _update_draws(
    draws: np.ndarray, select: np.ndarray, values: np.ndarray, exact: bool = False
) -> np.ndarray:
    """Update posterior draws with further knowledge about linear combinations of the parameters.

    Move each draw theta_i by K (p_i - H theta_i), K = C H^T (H C H^T + P)^-1. C is the draws' covariance.

    Args:
        draws: Draws theta_i, shape (parameters, draws).
        select: Matrix H, shape (rows, parameters).
        values: Draws p_i, shape (rows, draws).
        exact: True if P is 0; False if P is the covariance of `values`.
    """
    covariance = np.atleast_2d(np.cov(draws))
    across = covariance @ select.T
    spread = np.zeros((len(select), len(select))) if exact else np.atleast_2d(np.cov(values))
    return draws + across @ _invert_scaled(select @ across + spread) @ (values - select @ draws)


def _invert_scaled(covariance: np.ndarray) -> np.ndarray:
    """Return the pseudoinverse of a covariance matrix of parameters with different units."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(
        scale, scale
    )


def _draw_normal_marginals(prior: Mechanism, number: int, seed: int) -> DrawsByKey:
    """Draw the parameters with a normal prior distribution; each element of a list gets its own key."""
    normal = {key for key, entry in prior.uncertainty.items() if entry.distribution == "normal"}
    result: DrawsByKey = {}
    for key, values in draw(prior, number, seed).items():
        if key in normal:
            for index in np.ndindex(values.shape[1:]):
                result[".".join([key, *map(str, index)])] = values[(slice(None), *index)]
    return result


def _differentiate_lag(prior: Mechanism, keys: Sequence[str], frequency: float) -> dict[str, float]:
    """Return the derivatives of the motion simulator's phase delay [s] with respect to its parameters.

    The phase delay is evaluated at `frequency` [Hz].
    """
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
