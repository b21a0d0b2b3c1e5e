"""Force and position readings of the oracle's sensors."""

from __future__ import annotations

from itertools import pairwise
from math import ceil

import numpy as np
from oracle_contact import SMOOTH_NODES, SMOOTH_WEIGHTS
from scipy import signal

FORGOTTEN = 50.0  # time constants after which a lagging reading no longer depends on a past force


class LaggingSensor:
    """Force sensor with a lag of first order, or with a filter; without both, `time_constant` is 0."""

    def __init__(self, sensor, period):
        self.period, self.time_constant = period, sensor.get("time_constant", 0.0)
        self.state, self.cursor = 0.0, 0
        self.poles, self.gains = _filter_modes(sensor.get("filter"))
        if len(self.poles):
            self.time_constant = -1.0 / max(self.poles.real)
            self.state = 0.0 * self.poles

    def read(self, n, delay, pieces):
        """Return the output of the lag at t_n: tau y' = F(t - delay) - y, exact over the last period."""
        if n == 0:
            return 0.0
        start, end = n - 1 - delay, n - delay
        rate = self.period / self.time_constant
        total = 0.0
        while self.cursor < len(pieces) and pieces[self.cursor].end <= start:
            self.cursor += 1
        for piece in pieces[self.cursor :]:
            # Earlier forces no longer affect the reading.
            a, b = max(piece.start, start, end - FORGOTTEN / rate), min(piece.end, end)
            if piece.start >= end:
                break
            if piece.side == 0 or b <= a:
                continue
            # In time constants before the end: for a short lag, absolute times would lose digits.
            edges = np.linspace((end - a) * rate, (end - b) * rate, max(1, ceil((b - a) * rate)) + 1)
            for early, late in pairwise(edges):
                ago = early + (late - early) * SMOOTH_NODES
                forces = piece.force((end - ago / rate - piece.origin) / piece.length)
                if len(self.poles):
                    responses = np.exp(np.outer(self.poles, ago * self.time_constant)) * self.time_constant
                else:
                    responses = np.exp(-ago)
                total += (responses @ (forces * SMOOTH_WEIGHTS)) * (early - late)
        if len(self.poles):
            self.state = np.exp(self.poles * self.period) * self.state + total
            return float((self.gains @ self.state).real)
        self.state = float(np.exp(-rate)) * self.state + float(total)
        return self.state


def quantise(value, quantum):
    return quantum * np.round(value / quantum) if quantum > 0.0 else value


def _filter_modes(stated):
    """Return poles [1/s] and residues [1/s] of the sensor's filter; empty arrays without a filter."""
    if stated is None:
        return np.zeros(0), np.zeros(0)
    design = (
        signal.buttap(stated["order"])
        if stated["kind"] == "butterworth"
        else signal.besselap(stated["order"], norm="mag")
    )
    scale = 2.0 * np.pi * stated["cutoff"]
    residues, poles, _ = signal.residue(design[2], np.poly(design[1]))
    return poles * scale, residues * scale
