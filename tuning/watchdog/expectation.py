"""Fit of the watchdog's expected restitution of a contact to recorded contacts.

It is a polynomial in p = sqrt(k_0/k) - 1, w = v/v_0 - 1 and z = b/(2 sqrt(k M)), k and b as the watchdog
estimates them (`jaxhil.rig.watchdog`). An unknown delay delta of the force changes k only by a factor
cos(omega delta), but b by -k delta, which the rig cannot distinguish from damping. So b is used only if it
improves the expectation of contacts that were not fitted.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

TERMS = ("1", "p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
# Sets of terms, of which the first one that is sufficient, or about as good as the best, is selected.
FEATURES = (("1",), ("1", "p", "pp", "ppp"), TERMS[:7], TERMS)
AS_GOOD = 1.25  # rms residual over the best one, up to which a set is as good as the best
WIDER = 0.1  # share of a range by which it is widened on each side
SINGULAR = 1e-9  # relative singular value below which the fit is singular


class Expectation(NamedTuple):
    """Fitted polynomial of the expected restitution."""

    coefficients: dict[str, float]  # by term [1]
    stiffness: float  # reference stiffness k_0 [N/m]
    velocity: float  # reference speed v_0 [m/s]
    softness: tuple[float, float]  # fitted range of p
    speed: tuple[float, float]  # fitted range of w
    loss: tuple[float, float]  # fitted range of z

    def limits(self) -> dict[str, float]:
        """Return the expectation as limits of a gain file."""
        ranges = {"softness": self.softness, "speed": self.speed, "loss": self.loss}
        return {
            "reference_stiffness": self.stiffness,
            "reference_velocity": self.velocity,
            **{f"{name}_lowest": low for name, (low, _) in ranges.items()},
            **{f"{name}_highest": high for name, (_, high) in ranges.items()},
            **{f"expected_{term}": self.coefficients[term] for term in TERMS},
        }


class Features(NamedTuple):
    """Estimates of contacts from which the restitution is expected."""

    stiffness: Float[np.ndarray, "*shape"]  # estimate [N/m]; 0 if not observable
    damping: Float[np.ndarray, "*shape"]  # estimate [N s/m]
    velocity: Float[np.ndarray, "*shape"]  # approach speed [m/s]


def expected_restitution(expectation: Expectation, features: Features, mass: float) -> np.ndarray:
    """Return the watchdog's expected restitution, computed as in `jaxhil.rig.watchdog.Expectation`."""
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
    """Fit the restitution e* (`reference`) of contacts by least squares; `run` is the number of each's run.

    The simplest set of `FEATURES` is used whose rms residual on runs left out of the fit is at most `enough`,
    or about the best; it is then fitted to all runs. Simple sets are robust: a feature that hardly improves
    the fit over the sweep may be wrong for a rig that differs from the sweep. If no contact has a stiffness,
    the expectation is the mean.
    """
    observable = features.stiffness > 0
    if not np.any(observable):
        mean = float(np.mean(reference)) if len(reference) else 1.0
        span = (0.0, 0.0)
        return Expectation({**dict.fromkeys(TERMS, 0.0), "1": mean}, 1.0, 1.0, span, span, span)
    features = Features(*(leaf[observable] for leaf in features))
    reference, run = reference[observable], run[observable]
    stiffness, velocity = float(np.median(features.stiffness)), float(np.median(features.velocity))
    p, w, z = _shares(features, stiffness, velocity, mass)
    columns = np.stack([np.ones_like(p), p, p * p, p**3, w, w * w, p * w, z, z * z, p * z, w * z], axis=1)
    fitted = np.isin(run % 4, (0, 1))
    residuals = [_left_out(columns, terms, reference, fitted) for terms in FEATURES]
    enough = max(enough, AS_GOOD * min(residuals))
    terms = next(terms for terms, residual in zip(FEATURES, residuals, strict=True) if residual <= enough)
    solved = _solve(columns, terms, reference, np.ones(len(p), bool))
    coefficients = {**dict.fromkeys(TERMS, 0.0), **dict(zip(terms, map(float, solved), strict=True))}
    return Expectation(coefficients, stiffness, velocity, *(_span(share) for share in (p, w, z)))


def _left_out(columns, terms, reference, fitted: Bool[np.ndarray, "contacts"]) -> float:
    """Return the root mean square residual of the contacts that are not `fitted`."""
    if not np.any(fitted) or np.all(fitted):
        return 0.0 if len(terms) == 1 else np.inf
    solved = _solve(columns, terms, reference, fitted)
    residual = reference - columns[:, _indices(terms)] @ solved
    return float(np.sqrt(np.mean(residual[~fitted] ** 2)))


def _solve(columns, terms, reference, fitted) -> np.ndarray:
    chosen = columns[fitted][:, _indices(terms)]
    size = np.linalg.norm(chosen, axis=0)
    size[size == 0] = 1.0
    return np.linalg.lstsq(chosen / size, reference[fitted], rcond=SINGULAR)[0] / size


def _indices(terms: Sequence[str]) -> list[int]:
    return [TERMS.index(term) for term in terms]


def _shares(features: Features, stiffness: float, velocity: float, mass: float):
    """Return p, w and z."""
    with np.errstate(invalid="ignore", divide="ignore"):
        p = np.sqrt(stiffness / features.stiffness) - 1
        z = features.damping / (2 * np.sqrt(features.stiffness * mass))
    return p, features.velocity / velocity - 1, z


def _span(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    return low - WIDER * (high - low), high + WIDER * (high - low)


def _within(values: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    # The negated comparison also maps NaN to the low end.
    return np.where(~(values > span[0]), span[0], np.where(values < span[1], values, span[1]))
