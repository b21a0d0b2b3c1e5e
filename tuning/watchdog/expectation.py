"""The restitution that the watchdog expects of a contact, fitted to recorded contacts.

A polynomial in p = sqrt(k_0/k) - 1, w = v/v_0 - 1 and z = b/(2 sqrt(k M)), k and b as the watchdog identifies
them (`jaxhil.rig.watchdog`). An unknown delay delta of the force changes k by a factor cos(omega delta)
only, but b by -k delta, which nothing on the rig can tell from damping: b is used only where it helps
contacts that were not fitted.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

TERMS = ("1", "p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
# Tried in this order: the first that is good enough, or about as good as the best, is taken.
FEATURES = (("1",), ("1", "p", "pp", "ppp"), TERMS[:7], TERMS)
AS_GOOD = 1.25  # times the best rms residual
WIDER = 0.1  # of a range, on each side
SINGULAR = 1e-9


class Expectation(NamedTuple):
    """The fitted polynomial."""

    coefficients: dict[str, float]  # by term
    stiffness: float  # of reference, k_0 [N/m]
    velocity: float  # of reference, v_0 [m/s]
    softness: tuple[float, float]  # range of p that it was fitted over
    speed: tuple[float, float]  # range of w
    loss: tuple[float, float]  # range of z

    def limits(self) -> dict[str, float]:
        """As limits of a gain file."""
        ranges = {"softness": self.softness, "speed": self.speed, "loss": self.loss}
        return {
            "reference_stiffness": self.stiffness,
            "reference_velocity": self.velocity,
            **{f"{name}_lowest": low for name, (low, _) in ranges.items()},
            **{f"{name}_highest": high for name, (_, high) in ranges.items()},
            **{f"expected_{term}": self.coefficients[term] for term in TERMS},
        }


class Features(NamedTuple):
    """What is known of contacts; equal shapes."""

    stiffness: Float[np.ndarray, "*shape"]  # identified [N/m]
    damping: Float[np.ndarray, "*shape"]  # identified [N s/m]
    velocity: Float[np.ndarray, "*shape"]  # approach speed [m/s]


def expected_restitution(expectation: Expectation, features: Features, mass: float) -> np.ndarray:
    """What the watchdog expects; the arithmetic is `jaxhil.rig.watchdog.Expectation`'s."""
    p, w, z = _shares(features, expectation.stiffness, expectation.velocity, mass)
    p = _within(np.where(features.stiffness > 0, p, np.inf), expectation.softness)
    z = _within(np.where(features.stiffness > 0, z, -np.inf), expectation.loss)
    w = _within(w, expectation.speed)
    c = expectation.coefficients
    expected = c["1"] + p * (c["p"] + p * (c["pp"] + p * c["ppp"])) + w * (c["w"] + w * c["ww"] + p * c["pw"])
    return _within(expected + z * (c["z"] + z * c["zz"] + p * c["pz"] + w * c["wz"]), (0.0, 1.0))


def fit_expectation(
    features: Features, reference: Float[np.ndarray, "contacts"], run: np.ndarray, mass: float, enough: float
) -> Expectation:
    """Least squares over contacts, of `reference` restitution e*, each of the run with that number.

    Of `FEATURES`, the simplest is taken whose rms residual on runs left out of the fit is `enough`, or about
    that of the best; it is then fitted to all. Simple is safe: a feature that adds next to nothing over the
    sweep may mislead about a rig that is not as the sweep supposed. Without contacts whose stiffness is
    known, the mean is expected.
    """
    known = features.stiffness > 0
    if not np.any(known):
        mean = float(np.mean(reference)) if len(reference) else 1.0
        span = (0.0, 0.0)
        return Expectation({**dict.fromkeys(TERMS, 0.0), "1": mean}, 1.0, 1.0, span, span, span)
    features = Features(*(leaf[known] for leaf in features))
    reference, run = reference[known], run[known]
    stiffness, velocity = float(np.median(features.stiffness)), float(np.median(features.velocity))
    p, w, z = _shares(features, stiffness, velocity, mass)
    columns = np.stack([np.ones_like(p), p, p * p, p**3, w, w * w, p * w, z, z * z, p * z, w * z], axis=1)
    fitted = np.isin(run % 4, (0, 1))
    residuals = [_left_out(columns, terms, reference, fitted) for terms in FEATURES]
    enough = max(enough, AS_GOOD * min(residuals))
    terms = next(one for one, residual in zip(FEATURES, residuals, strict=True) if residual <= enough)
    solved = _solve(columns, terms, reference, np.ones(len(p), bool))
    coefficients = {**dict.fromkeys(TERMS, 0.0), **dict(zip(terms, map(float, solved), strict=True))}
    return Expectation(coefficients, stiffness, velocity, *(_span(share) for share in (p, w, z)))


def _left_out(columns, terms, reference, fitted: Bool[np.ndarray, "contacts"]) -> float:
    """Root mean square residual of the contacts that are not `fitted`."""
    if not np.any(fitted) or np.all(fitted):
        return 0.0 if len(terms) == 1 else np.inf
    solved = _solve(columns, terms, reference, fitted)
    residual = reference - columns[:, _places(terms)] @ solved
    return float(np.sqrt(np.mean(residual[~fitted] ** 2)))


def _solve(columns, terms, reference, fitted) -> np.ndarray:
    chosen = columns[fitted][:, _places(terms)]
    size = np.linalg.norm(chosen, axis=0)
    size[size == 0] = 1.0
    return np.linalg.lstsq(chosen / size, reference[fitted], rcond=SINGULAR)[0] / size


def _places(terms: Sequence[str]) -> list[int]:
    return [TERMS.index(term) for term in terms]


def _shares(features: Features, stiffness: float, velocity: float, mass: float):
    """p, w and z."""
    with np.errstate(invalid="ignore", divide="ignore"):
        p = np.sqrt(stiffness / features.stiffness) - 1
        z = features.damping / (2 * np.sqrt(features.stiffness * mass))
    return p, features.velocity / velocity - 1, z


def _span(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    return low - WIDER * (high - low), high + WIDER * (high - low)


def _within(values: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    # What is not a number goes to an end as well.
    return np.where(~(values > span[0]), span[0], np.where(values < span[1], values, span[1]))
