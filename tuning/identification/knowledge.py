"""What is known beside the logs: numbers that are told, and the normal marginals of a prior.

What logs tell is a set of draws with mean m and covariance C. To know besides that H theta is normal, with
mean p and covariance P, moves draw i by

    K (p_i - H theta_i),    K = C H^T (H C H^T + P)^-1,

p_i a draw of what is known (Matheron's rule, the residuals of a Kalman update). Exact where the draws are
normal; a number that is told has P = 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from jaxhil.errors import InputError, one_line
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from tuning.identification import known

Draws = dict[str, np.ndarray]

AGAINST = 4.0  # standard deviations by which the logs deny what is told
FORCE_DELAY, SIMULATOR = "rig.force_sensor.delay", "rig.simulator."


def spread_out(fixed: Mapping[str, Any], found: Sequence[str]) -> dict[str, float]:
    """Told numbers by key, lists entry by entry; a number for a list is that of each of its entries.

    Raises `InputError` for a key that logs do not tell, and for a list of another length."""
    told: dict[str, float] = {}
    for key, value in fixed.items():
        entries = [one for one in found if one == key or one.startswith(f"{key}.")]
        values = _flat(key, value)
        if isinstance(value, (int, float)):
            values = dict.fromkeys(entries, float(value))
        unknown = [one for one in values if one not in found]
        if not values or unknown:
            allowed = ", ".join(found) or "nothing: these logs tell no number"
            raise InputError(f"fix: found {one_line((*unknown, key)[0], 60)}, allowed {allowed}")
        told |= values
    return told


def _flat(key: str, value: Any) -> dict[str, float]:
    if isinstance(value, (list, tuple)):
        return {k: v for i, one in enumerate(value) for k, v in _flat(f"{key}.{i}", one).items()}
    return {key: float(value)}


def with_told(found: Draws, told: Mapping[str, float]) -> tuple[Draws, list[str]]:
    """The draws of the other numbers, those told as they are, and a note for each that the logs deny."""
    if not told:
        return found, []
    keys, held = list(found), [list(found).index(key) for key in told]
    notes = []
    for key, value in told.items():
        mean, std = found[key].mean(), found[key].std(ddof=1)
        if abs(value - mean) > AGAINST * std:
            notes.append(f"{key}: {value:g} was told, the logs say {mean:.5g} +- {std:.2g}")
    values = np.broadcast_to(np.array(list(told.values())), (len(next(iter(found.values()))), len(told)))
    moved = _moved(np.array(list(found.values())), np.eye(len(keys))[held], values.T, exact=True)
    return {key: row for key, row in zip(keys, moved, strict=True) if key not in told}, notes


def with_prior(found: Draws, prior: Mechanism, frequency: float, seed: int = 0) -> Draws:
    """The draws under the prior's normal marginals, with its correlation. Numbers of the simulator and of
    the prior's correlation that these logs do not tell are then among them.

    `frequency` of contacts [Hz]: at it an error of the simulator's lag is one of the force delay. Raises
    `InputError` where no number of the logs has a normal marginal."""
    marginals = _normal_draws(prior, len(next(iter(found.values()), ())), seed)
    both = [key for key in marginals if key in found]
    if not both:
        allowed = f"a normal one of {', '.join(found) or 'what logs tell'}"
        raise InputError(f"prior: [uncertainty]: found no entry of what the logs tell, allowed {allowed}")
    linked = () if prior.correlation is None else prior.correlation.keys
    carried = [
        key
        for key in marginals
        if key not in found and (key.startswith(SIMULATOR) or key.rstrip("0123456789.") in linked)
    ]
    whole = {**found, **{key: marginals[key] for key in carried}}
    if FORCE_DELAY in found:
        lag = _lag_slopes(prior, [key for key in carried if key.startswith(SIMULATOR)], frequency)
        off = [slope * (marginals[key] - marginals[key].mean()) for key, slope in lag.items()]
        whole[FORCE_DELAY] = found[FORCE_DELAY] - sum(off, np.zeros(1))
    keys = list(whole)
    select = np.zeros((len(both), len(keys)))
    select[np.arange(len(both)), [keys.index(key) for key in both]] = 1.0
    values = np.array([marginals[key] for key in both])
    if carried:
        # What is left of the marginals given the numbers that are the prior's alone.
        beside = np.array([marginals[key] for key in carried])
        one, other = np.cov(values, beside), len(both)
        follow = one[:other, other:] @ _inverse(one[other:, other:])
        select[:, [keys.index(key) for key in carried]] = -follow
        values = values - follow @ beside
    moved = _moved(np.array(list(whole.values())), select, values)
    result = dict(zip(keys, moved, strict=True))
    return {k: np.maximum(v, 0.0) if k.startswith("contact.damping") else v for k, v in result.items()}


def _moved(draws: np.ndarray, select: np.ndarray, values: np.ndarray, exact: bool = False) -> np.ndarray:
    """Draws (keys, draws) moved by what is known of `select` times them: `values` (rows, draws)."""
    covariance = np.atleast_2d(np.cov(draws))
    across = covariance @ select.T
    spread = np.zeros((len(select), len(select))) if exact else np.atleast_2d(np.cov(values))
    return draws + across @ _inverse(select @ across + spread) @ (values - select @ draws)


def _inverse(covariance: np.ndarray) -> np.ndarray:
    """Of numbers in units far apart, some of which may be functions of others."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(
        scale, scale
    )


def _normal_draws(prior: Mechanism, number: int, seed: int) -> Draws:
    """Of the prior's numbers with a normal marginal, lists entry by entry."""
    normal = {key for key, one in prior.uncertainty.items() if one.distribution == "normal"}
    found: Draws = {}
    for key, values in draw(prior, number, seed).items():
        if key in normal:
            for place in np.ndindex(values.shape[1:]):
                found[".".join([key, *map(str, place)])] = values[(slice(None), *place)]
    return found


def _lag_slopes(prior: Mechanism, keys: Sequence[str], frequency: float) -> dict[str, float]:
    """By how much the motion's lag at a frequency [Hz] grows with a number of the simulator [s per unit]."""
    simulator = prior.rig.simulator
    s = np.array([2j * np.pi * frequency])

    def lag(name: str, value: float) -> float:
        moved = msgspec.structs.replace(simulator, **{name: value})
        rig = msgspec.structs.replace(prior.rig, simulator=moved)
        model = known.motion_model(msgspec.structs.replace(prior, rig=rig))
        return -float(np.angle(model.response(s)[0])) / (2.0 * np.pi * frequency)

    slopes = {}
    for key in keys:
        name = key.removeprefix(SIMULATOR)
        value = getattr(simulator, name, None)
        if isinstance(value, float) and value:
            slopes[key] = (lag(name, 1.0001 * value) - lag(name, 0.9999 * value)) / (0.0002 * value)
    return slopes
