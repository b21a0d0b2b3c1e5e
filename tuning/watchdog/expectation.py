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

POLYNOMIAL_TERMS = ("1", "p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
# Sets of terms, of which the first one that is sufficient, or about as good as the best, is selected.
TERM_SETS = (("1",), ("1", "p", "pp", "ppp"), POLYNOMIAL_TERMS[:7], POLYNOMIAL_TERMS)
MAX_RESIDUAL_RATIO = 1.25  # rms residual over the best one, up to which a set is as good as the best
RANGE_EXTENSION = 0.1  # share of a range by which it is widened on each side
SINGULAR_VALUE_CUTOFF = 1e-9  # relative singular value below which the fit is singular


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
            **{f"expected_{term}": self.coefficients[term] for term in POLYNOMIAL_TERMS},
        }


class ContactFeatures(NamedTuple):
    """Estimates of contacts from which the restitution is expected."""

    stiffness: Float[np.ndarray, "*shape"]  # estimate [N/m]; 0 if not observable
    damping: Float[np.ndarray, "*shape"]  # estimate [N s/m]
    velocity: Float[np.ndarray, "*shape"]  # approach speed [m/s]


def expected_restitution(expectation: Expectation, features: ContactFeatures, mass: float) -> np.ndarray:
    """Return the watchdog's expected restitution, computed as in `jaxhil.rig.watchdog.Expectation`."""
    p, w, z = _normalise_features(features, expectation.stiffness, expectation.velocity, mass)
    p = _clip_to_range(np.where(features.stiffness > 0, p, np.inf), expectation.softness)
    z = _clip_to_range(np.where(features.stiffness > 0, z, -np.inf), expectation.loss)
    w = _clip_to_range(w, expectation.speed)
    c = expectation.coefficients
    expected = c["1"] + p * (c["p"] + p * (c["pp"] + p * c["ppp"])) + w * (c["w"] + w * c["ww"] + p * c["pw"])
    return _clip_to_range(expected + z * (c["z"] + z * c["zz"] + p * c["pz"] + w * c["wz"]), (0.0, 1.0))


def fit_expectation(
    features: ContactFeatures,
    reference: Float[np.ndarray, "contacts"],
    run: np.ndarray,
    mass: float,
    enough: float,
) -> Expectation:
    """Fit the restitution e* (`reference`) of contacts by least squares; `run` is the number of each's run.

    The simplest set of `TERM_SETS` is used whose rms residual on runs left out of the fit is at most
    `enough`, or about the best; it is then fitted to all runs. Simple sets are robust: a feature that hardly
    improves the fit over the sweep may be wrong for a rig that differs from the sweep. If no contact has a
    stiffness, the expectation is the mean.
    """
    observable = features.stiffness > 0
    if not np.any(observable):
        mean = float(np.mean(reference)) if len(reference) else 1.0
        span = (0.0, 0.0)
        return Expectation({**dict.fromkeys(POLYNOMIAL_TERMS, 0.0), "1": mean}, 1.0, 1.0, span, span, span)
    features = ContactFeatures(*(leaf[observable] for leaf in features))
    reference, run = reference[observable], run[observable]
    stiffness, velocity = float(np.median(features.stiffness)), float(np.median(features.velocity))
    p, w, z = _normalise_features(features, stiffness, velocity, mass)
    columns = np.stack([np.ones_like(p), p, p * p, p**3, w, w * w, p * w, z, z * z, p * z, w * z], axis=1)
    fitted = np.isin(run % 4, (0, 1))
    residuals = [_compute_left_out_rms(columns, terms, reference, fitted) for terms in TERM_SETS]
    enough = max(enough, MAX_RESIDUAL_RATIO * min(residuals))
    terms = next(terms for terms, residual in zip(TERM_SETS, residuals, strict=True) if residual <= enough)
    solved = _solve_least_squares(columns, terms, reference, np.ones(len(p), bool))
    coefficients = {
        **dict.fromkeys(POLYNOMIAL_TERMS, 0.0),
        **dict(zip(terms, map(float, solved), strict=True)),
    }
    return Expectation(coefficients, stiffness, velocity, *(_find_range(share) for share in (p, w, z)))


def _compute_left_out_rms(columns, terms, reference, fitted: Bool[np.ndarray, "contacts"]) -> float:
    """Return the root mean square residual of the contacts that are not `fitted`."""
    if not np.any(fitted) or np.all(fitted):
        return 0.0 if len(terms) == 1 else np.inf
    solved = _solve_least_squares(columns, terms, reference, fitted)
    residual = reference - columns[:, _find_term_indices(terms)] @ solved
    return float(np.sqrt(np.mean(residual[~fitted] ** 2)))


def _solve_least_squares(columns, terms, reference, fitted) -> np.ndarray:
    chosen = columns[fitted][:, _find_term_indices(terms)]
    size = np.linalg.norm(chosen, axis=0)
    size[size == 0] = 1.0
    return np.linalg.lstsq(chosen / size, reference[fitted], rcond=SINGULAR_VALUE_CUTOFF)[0] / size


def _find_term_indices(terms: Sequence[str]) -> list[int]:
    return [POLYNOMIAL_TERMS.index(term) for term in terms]


def _normalise_features(features: ContactFeatures, stiffness: float, velocity: float, mass: float):
    """Return p, w and z."""
    with np.errstate(invalid="ignore", divide="ignore"):
        p = np.sqrt(stiffness / features.stiffness) - 1
        z = features.damping / (2 * np.sqrt(features.stiffness * mass))
    return p, features.velocity / velocity - 1, z


def _find_range(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    return low - RANGE_EXTENSION * (high - low), high + RANGE_EXTENSION * (high - low)


def _clip_to_range(values: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    # The negated comparison also maps NaN to the low end.
    return np.where(~(values > span[0]), span[0], np.where(values < span[1], values, span[1]))
