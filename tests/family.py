"""Generated mechanisms that cover the range of rigs and docking mechanisms in practice.

Each member is the text of a mechanism file, made from one point of a scrambled Sobol sequence: contact law,
contact frequency (log-uniform), damping ratio (0 for an eighth of them), delays, motion simulator, mass and
approach speed. A shorter family is the beginning of a longer one. `python -m tests.family FOLDER` writes it.
The contact frequency f [Hz] is the frequency for which the undamped contact lasts 1/(2 f); for a linear
contact f = sqrt(k/M)/(2 pi). The damping ratio xi belongs to a linear contact of this frequency, b = 2 xi M
(2 pi f). For Hunt-Crossley, chi = pi xi / v, which has the same loss to first order in xi (e is exp(-pi xi)
for the linear contact, 1 - chi v here).
"""

import argparse
import math
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from jaxhil.mechanism.file import from_plain_data
from jaxhil.mechanism.structs import Mechanism

NUMBER = 64
EXPONENT = 1.5  # Hertz
LAWS = "kelvin_voigt", "piecewise_linear", "hunt_crossley"
UNDAMPED = 1 / 8  # share of members with damping ratio 0


class Ranges(NamedTuple):
    """Lower and upper limits of the generated values, uniform except for the log-uniform frequency.

    Contact frequency [Hz], damping ratio [1], mass [kg], approach speed [m/s]; force delay [s]; natural
    frequency [Hz], damping ratio [1] and transport delay [s] of the motion simulator. For layered contact:
    ratio of the slopes, and depth of the first layer relative to the depth v/sqrt(k_1/M) that the first layer
    alone would reach.
    """

    frequency: tuple[float, float] = 1.0, 8.0
    damping_ratio: tuple[float, float] = 0.0, 0.1
    mass: tuple[float, float] = 200.0, 500.0
    velocity: tuple[float, float] = 0.005, 0.010
    force_delay: tuple[float, float] = 0.002, 0.010
    simulator_frequency: tuple[float, float] = 8.0, 30.0
    simulator_damping: tuple[float, float] = 0.7, 1.0
    simulator_delay: tuple[float, float] = 0.0, 0.004
    slope_ratio: tuple[float, float] = 2.0, 6.0
    layer: tuple[float, float] = 0.2, 0.7


RANGES = Ranges()

TEMPLATE = """schema = "jaxhil/mechanism/1"
name = "{name}"
source = "generated: a scrambled Sobol sequence over contact, masses and rig"

[bodies]
equivalent_mass = {mass:.6g}

[approach]
velocity = {velocity:.6g}

[contact]
law = "{law}"
{contact}

[rig]
control_period = 0.001

[rig.simulator]
model = "second_order"
natural_frequency = {simulator_frequency:.6g}
damping_ratio = {simulator_damping:.6g}
delay = {simulator_delay:.6g}

[rig.force_sensor]
delay = {force_delay:.6g}

[uncertainty]
"contact.stiffness" = {{ distribution = "loguniform", factor = [0.6, 1.6] }}
"rig.force_sensor.delay" = {{ distribution = "normal", std = 0.0003 }}
"approach.phase" = {{ distribution = "uniform", low = 0.0, high = 1.0 }}
"""


def texts(number: int = NUMBER, seed: int = 0) -> dict[str, str]:
    """Return mechanism files by the mechanisms' names, such as ``03-hunt_crossley-1.7Hz``."""
    # One column for each range, and one for the contact law.
    sequence = qmc.Sobol(len(RANGES) + 1, rng=np.random.default_rng(seed))
    shares = sequence.random(1 << max(number - 1, 0).bit_length())[:number]
    made = [_member(index, row) for index, row in enumerate(shares)]
    return dict(made)


def family(number: int = NUMBER, seed: int = 0) -> list[Mechanism]:
    """Return the mechanisms of `texts` in the same order."""
    return [from_plain_data(tomllib.loads(text), name) for name, text in texts(number, seed).items()]


def write(folder: str | Path, number: int = NUMBER, seed: int = 0) -> list[Path]:
    """Write ``NAME.toml`` of every member to `folder`; create the folder if necessary."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, text in texts(number, seed).items():
        paths.append(folder / f"{name}.toml")
        paths[-1].write_text(text, encoding="utf-8", newline="\n")
    return paths


def _member(index: int, shares: np.ndarray) -> tuple[str, str]:
    which, *others = (float(share) for share in shares)
    drawn = {
        name: low + (high - low) * share
        for (name, (low, high)), share in zip(RANGES._asdict().items(), others, strict=True)
    }
    low, high = RANGES.frequency
    frequency = low * (high / low) ** others[0]
    damped = (others[1] - UNDAMPED) / (1 - UNDAMPED)
    damping_ratio = max(0.0, RANGES.damping_ratio[1] * damped)
    law = LAWS[min(int(len(LAWS) * which), len(LAWS) - 1)]
    name = f"{index:02d}-{law}-{frequency:.1f}Hz"
    contact = _CONTACTS[law](frequency, damping_ratio, drawn)
    lines = "\n".join(f"{key} = {value}" for key, value in contact.items())
    return name, TEMPLATE.format(name=name, law=law, contact=lines, **drawn)


def _kelvin_voigt(frequency: float, damping_ratio: float, drawn: dict[str, float]) -> dict[str, str]:
    mass, omega = drawn["mass"], 2 * math.pi * frequency
    return {"stiffness": f"[{mass * omega**2:.6g}]", "damping": f"[{2 * damping_ratio * mass * omega:.6g}]"}


def _piecewise_linear(frequency: float, damping_ratio: float, drawn: dict[str, float]) -> dict[str, str]:
    """Return the parameters of a contact with two layers.

    The undamped contact passes the first layer in asin(s)/omega_1 and turns round atan(sqrt(r) sqrt(1 -
    s^2)/s)/(sqrt(r) omega_1) later, where s is the value of `layer`, r the ratio of the slopes, and omega_1^2
    = k_1/M.
    """
    mass, velocity, ratio, share = (drawn[key] for key in ("mass", "velocity", "slope_ratio", "layer"))
    root = math.sqrt(ratio)
    quarter = math.asin(share) + math.atan2(root * math.sqrt(1 - share**2), share) / root
    first = 4 * frequency * quarter
    slope = mass * first**2
    return {
        "stiffness": f"[[{slope:.6g}, {ratio * slope:.6g}]]",
        "depths": f"[{share * velocity / first:.6g}]",
        "damping": f"[{2 * damping_ratio * mass * 2 * math.pi * frequency:.6g}]",
    }


def _hunt_crossley(frequency: float, damping_ratio: float, drawn: dict[str, float]) -> dict[str, str]:
    """Return the parameters of a Hunt-Crossley contact.

    The undamped contact with F = k d^n reaches the depth D with k D^(n+1) = (n + 1) M v^2 / 2, and lasts 2
    D/v sqrt(pi) gamma(1 + 1/(n+1)) / gamma(1/2 + 1/(n+1)) (Hertz, n = 1.5: 2.94 D/v).
    """
    mass, velocity, order = drawn["mass"], drawn["velocity"], EXPONENT + 1
    shape = 2 * math.sqrt(math.pi) * math.gamma(1 + 1 / order) / math.gamma(0.5 + 1 / order)
    depth = velocity / (2 * frequency * shape)
    stiffness = order * mass * velocity**2 / (2 * depth**order)
    return {
        "exponent": f"{EXPONENT}",
        "stiffness": f"[{stiffness:.6g}]",
        "damping": f"[{math.pi * damping_ratio / velocity:.6g}]",
    }


_CONTACTS = {
    "kelvin_voigt": _kelvin_voigt,
    "piecewise_linear": _piecewise_linear,
    "hunt_crossley": _hunt_crossley,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the family of mechanism files.")
    parser.add_argument("folder", type=Path, help="where to, made if need be")
    parser.add_argument("--number", type=int, default=NUMBER, help=f"how many (default: {NUMBER})")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (default: 0)")
    arguments = parser.parse_args()
    paths = write(arguments.folder, arguments.number, arguments.seed)
    print(f"wrote {len(paths)} mechanisms to {arguments.folder}")


if __name__ == "__main__":
    main()
