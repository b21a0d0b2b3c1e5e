"""For several assumed surface positions: the rows near contact, and the onsets of contact between rows."""

from typing import NamedTuple

import numpy as np


class NearbyRows(NamedTuple):
    """Rows near contact: motion at a fixed time before each row, and depth for several surface positions."""

    rows: np.ndarray  # (rows,), flat indices into an array (rows, lanes); -1 after the end of a lane
    position: np.ndarray  # (rows,), position of the mechanism [m]
    depth: np.ndarray  # (surface positions, rows), penetration [m]; 0 out of contact
    rate: np.ndarray  # (rows,), rate of the penetration [m/s]
    columns: np.ndarray  # (surface positions, coefficients, rows), regressors of the law, without the bias


class Onsets(NamedTuple):
    """Onsets of contact, each of them between two successive rows."""

    plane: np.ndarray  # (onsets,), index of the surface position
    row: np.ndarray  # (onsets,), index into `NearbyRows.rows` of the row after the onset
    columns: np.ndarray  # (coefficients, onsets), regressors of the law just after the onset
    share: np.ndarray  # (onsets,), share of the period that lies after the onset
