"""Random walk of the force sensor's bias on a simulated rig with one axis.

The walk equals that of `jaxhil.simulation.sensors` for the same seed, scenario, contact and ticks.
"""

import math
from statistics import NormalDist

from jaxhil.mechanism.structs import Mechanism

# Constants of `jaxhil.simulation.sensors`, which imports JAX.
BIAS_WALK_STREAM = 0x20000000
THREEFRY_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
THREEFRY_PARITY = 0x1BD11BDA
WORD = 0xFFFFFFFF  # mask of a 32-bit word
STANDARD_NORMAL = NormalDist()


class BiasWalk:
    """Change of the force sensor's bias since the start of a run.

    Args:
        mechanism: mechanism and rig.
        seed: seed of the random numbers.
    """

    def __init__(self, mechanism: Mechanism, seed: int) -> None:
        self._step = mechanism.rig.force_sensor.bias_random_walk * math.sqrt(mechanism.rig.control_period)
        self._seed = seed
        self.begin(0)

    def begin(self, scenario: int) -> None:
        """Begin a run; `scenario` is the index of the scenario to which the run belongs."""
        self._scenario, self._tick, self._change = scenario, 0, 0.0

    def read(self, tick: int, contact: int) -> float:
        """Return the change of the bias [N] at this tick, which is the last tick or the next one.

        `contact` is the index of the run's current contact.
        """
        if self._step > 0.0 and tick > self._tick:
            bits = threefry((self._seed, self._scenario), (contact + BIAS_WALK_STREAM, tick))[0]
            self._change += self._step * STANDARD_NORMAL.inv_cdf((2 * bits + 1) / 2**33)
            self._tick = tick
        return self._change


def threefry(key: tuple[int, int], count: tuple[int, int]) -> tuple[int, int]:
    """Return 64 random bits, as two words, for a key of two words and a counter of two words.

    The algorithm is Threefry-2x32 with 20 rounds, as in `jaxhil.simulation.sensors.threefry`.
    """
    keys = key[0] & WORD, key[1] & WORD, (key[0] ^ key[1] ^ THREEFRY_PARITY) & WORD
    left, right = (count[0] + keys[0]) & WORD, (count[1] + keys[1]) & WORD
    for turn in range(5):
        for rotation in THREEFRY_ROTATIONS[turn % 2]:
            left = (left + right) & WORD
            right = left ^ (((right << rotation) | (right >> (32 - rotation))) & WORD)
        left = (left + keys[(turn + 1) % 3]) & WORD
        right = (right + keys[(turn + 2) % 3] + turn + 1) & WORD
    return left, right
