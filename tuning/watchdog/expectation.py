"""Fit of the watchdog's expected restitution to recorded contacts.

The expected restitution is a polynomial in p = sqrt(k_0/k) - 1, w = v/v_0 - 1 and z = b/(2 sqrt(k M)). Here v
is the approach speed, M the equivalent mass, k and b are the stiffness and damping that the watchdog
estimates (`jaxhil.rig.watchdog`), and k_0 and v_0 are reference values. An unknown delay delta of the force
changes the estimate of k only by the factor cos(omega delta), but the estimate of b by -k delta, which the
rig cannot distinguish from damping. The polynomial contains b only if this reduces the error for contacts to
which it was not fitted.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

POLYNOMIAL_TERMS = ("1", "p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
# Sets of terms, simplest first. `fit_expectation` selects the first sufficient set.
TERM_SETS = (("1",), ("1", "p", "pp", "ppp"), POLYNOMIAL_TERMS[:7], POLYNOMIAL_TERMS)
MAX_RESIDUAL_RATIO = 1.25  # largest rms residual of a sufficient set / smallest rms residual [1]
RANGE_EXTENSION = 0.1  # extension of a fitted range on each side, divided by the range's width [1]
SINGULAR_VALUE_CUTOFF = 1e-9  # singular values below this, relative to the largest, count as 0 [1]


class ExpectationFit(NamedTuple):
    """Expected restitution: polynomial in p (from the stiffness), w (approach speed) and z (damping)."""

    coefficients: dict[str, float]  # coefficient of each of `POLYNOMIAL_TERMS` [1]
    stiffness: float  # reference stiffness k_0 [N/m]
    velocity: float  # reference speed v_0 [m/s]
    softness: tuple[float, float]  # range of p in which the polynomial is valid [1]
    speed: tuple[float, float]  # range of w in which the polynomial is valid [1]
    loss: tuple[float, float]  # range of z in which the polynomial is valid [1]

    def limits(self) -> dict[str, float]:
        """Return all fields of this fit as entries of the gain file's `limits`."""
        ranges = {"softness": self.softness, "speed": self.speed, "loss": self.loss}
        return {
            "reference_stiffness": self.stiffness,
            "reference_velocity": self.velocity,
            **{f"{name}_lowest": low for name, (low, _) in ranges.items()},
            **{f"{name}_highest": high for name, (_, high) in ranges.items()},
            **{f"expected_{term}": self.coefficients[term] for term in POLYNOMIAL_TERMS},
        }


class ContactFeatures(NamedTuple):
    """Inputs of the expected restitution, for many contacts."""

    stiffness: Float[np.ndarray, "*shape"]  # estimated stiffness [N/m]; 0 if not observable
    damping: Float[np.ndarray, "*shape"]  # estimated damping [N s/m]
    velocity: Float[np.ndarray, "*shape"]  # approach speed [m/s]


def expected_restitution(expectation: ExpectationFit, features: ContactFeatures, mass: float) -> np.ndarray:
    """Return the expected restitution of contacts [1], as `jaxhil.rig.watchdog.Expectation` computes it."""
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
    sufficient: float,
) -> ExpectationFit:
    """Fit the expected restitution to the ideal restitution e* of contacts, by least squares.

    Every set of polynomial terms in `TERM_SETS` is first fitted to half of the runs. A set is sufficient if
    its rms residual in the other half is at most `sufficient`, or at most `MAX_RESIDUAL_RATIO` times the
    smallest rms residual of all sets. The simplest sufficient set is then fitted to all runs. Further terms
    would hardly improve the fit, and may be wrong on the real rig. Contacts without an estimate of the
    stiffness are not used. If no contact has such an estimate, the expectation is the mean of e*.

    Args:
        features: stiffness, damping and approach speed of the contacts.
        reference: restitution e* of the ideal contacts, (contacts,).
        run: number of each contact's run, (contacts,).
        mass: equivalent mass [kg].
        sufficient: rms residual [1] up to which a set of terms is always sufficient.
    """
    observable = features.stiffness > 0
    if not np.any(observable):
        mean = float(np.mean(reference)) if len(reference) else 1.0
        span = (0.0, 0.0)
        return ExpectationFit({**dict.fromkeys(POLYNOMIAL_TERMS, 0.0), "1": mean}, 1.0, 1.0, span, span, span)
    features = ContactFeatures(*(leaf[observable] for leaf in features))
    reference, run = reference[observable], run[observable]
    stiffness, velocity = float(np.median(features.stiffness)), float(np.median(features.velocity))
    p, w, z = _normalise_features(features, stiffness, velocity, mass)
    columns = np.stack([np.ones_like(p), p, p * p, p**3, w, w * w, p * w, z, z * z, p * z, w * z], axis=1)
    fitted = np.isin(run % 4, (0, 1))
    residuals = [_compute_validation_rms(columns, terms, reference, fitted) for terms in TERM_SETS]
    sufficient = max(sufficient, MAX_RESIDUAL_RATIO * min(residuals))
    candidates = zip(TERM_SETS, residuals, strict=True)
    terms = next(terms for terms, residual in candidates if residual <= sufficient)
    solved = _solve_least_squares(columns, terms, reference, np.ones(len(p), bool))
    coefficients = {
        **dict.fromkeys(POLYNOMIAL_TERMS, 0.0),
        **dict(zip(terms, map(float, solved), strict=True)),
    }
    return ExpectationFit(coefficients, stiffness, velocity, *(_find_range(share) for share in (p, w, z)))


def _compute_validation_rms(columns, terms, reference, fitted: Bool[np.ndarray, "contacts"]) -> float:
    """Fit a set of terms to the contacts `fitted`; return the rms residual of the other contacts."""
    if not np.any(fitted) or np.all(fitted):
        return 0.0 if len(terms) == 1 else np.inf
    solved = _solve_least_squares(columns, terms, reference, fitted)
    residual = reference - columns[:, _find_term_indices(terms)] @ solved
    return float(np.sqrt(np.mean(residual[~fitted] ** 2)))


def _solve_least_squares(columns, terms, reference, fitted) -> np.ndarray:
    chosen = columns[fitted][:, _find_term_indices(terms)]
    norms = np.linalg.norm(chosen, axis=0)
    norms[norms == 0] = 1.0
    return np.linalg.lstsq(chosen / norms, reference[fitted], rcond=SINGULAR_VALUE_CUTOFF)[0] / norms


def _find_term_indices(terms: Sequence[str]) -> list[int]:
    return [POLYNOMIAL_TERMS.index(term) for term in terms]


def _normalise_features(features: ContactFeatures, stiffness: float, velocity: float, mass: float):
    """Return the dimensionless p (stiffness), w (approach speed) and z (damping), each (contacts,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        p = np.sqrt(stiffness / features.stiffness) - 1
        z = features.damping / (2 * np.sqrt(features.stiffness * mass))
    return p, features.velocity / velocity - 1, z


def _find_range(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    return low - RANGE_EXTENSION * (high - low), high + RANGE_EXTENSION * (high - low)


def _clip_to_range(values: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    # The negated comparison also maps NaN to the lower bound.
    return np.where(~(values > span[0]), span[0], np.where(values < span[1], values, span[1]))
