"""Floats with randomly rounded results: Monte Carlo arithmetic (Parker, Pierce and Eggert 2000)."""

import math
import random

import numpy as np


class Jittered(float):
    """Float whose arithmetic randomly keeps each result or moves it to a neighbouring float."""

    generator = random.Random(0)


def _jittered(operation):
    def operate(self, other):
        if isinstance(other, np.ndarray):
            return NotImplemented
        towards = Jittered.generator.choice((-math.inf, None, math.inf))
        result = operation(float(self), float(other))
        # A result of 0 is exact and stays unchanged.
        return Jittered(result if towards is None or result == 0 else math.nextafter(result, towards))

    return operate


for _name in ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv"):
    setattr(Jittered, f"__{_name}__", _jittered(getattr(float, f"__{_name}__")))
