"""Summary of a six-axis mechanism: first ideal contact, delay of the rig, and implausible values."""

import math
from typing import NamedTuple

from jaxhil.laws.shared.nominal_values import axis_lags, force_delay
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.sixdof.units import unit_warnings

MAX_FREQUENCY_RATIO = 0.1  # highest plausible contact frequency, divided by the control rate [1]


class SixAxisSummary(NamedTuple):
    """Summary of a nominal six-axis mechanism; metrics of the contact are NaN if nothing touches.

    Attributes:
        effective_mass: Effective mass m_n at the first touch [kg].
        frequency: Frequency of the ideal contact, 1/(2 duration) [Hz]; NaN if a latch catches.
        peak_force: Peak force of the ideal contact [N].
        restitution: Restitution e* of the ideal contact [1]; NaN unless there is a single touch.
        delay: Delay of the loop [s]: sum of the delays and lags of the force sensor and the slowest axis.
        slip_limit: Minimum slip parameter v_s of regularised friction for a stable rig [m/s]; NaN without
            regularised friction.
        warnings: Implausible values of the file, each with key, found value and expected value.
    """

    effective_mass: float
    frequency: float
    peak_force: float
    restitution: float
    delay: float
    slip_limit: float
    warnings: tuple[str, ...]

    def line(self, name: str) -> str:
        """Return the summary without the warnings as one line of text, which begins with `name`."""
        if math.isnan(self.effective_mass):
            return f"{name}: nothing touches; rig: delay {1e3 * self.delay:.3g} ms"
        rebound = "" if math.isnan(self.restitution) else f", e* {self.restitution:.3g}"
        kind = "held by a latch" if math.isnan(self.frequency) else f"{self.frequency:.3g} Hz"
        text = f"{name}: effective mass {self.effective_mass:.4g} kg at the first touch; ideal contact: "
        text += f"{kind}, peak force {self.peak_force:.3g} N{rebound}; rig: delay {1e3 * self.delay:.3g} ms"
        if not math.isnan(self.slip_limit):
            text += f", friction stable if its slip parameter is above {self.slip_limit:.2g} m/s"
        return text


def summarise_six_axes(
    mechanism: SixAxisMechanism,
    effective_mass: float,
    tangential_mass: float,
    duration: float,
    peak_force: float,
    restitution: float,
) -> SixAxisSummary:
    """Summarise a mechanism whose first ideal contact has the given metrics, in SI units.

    `tangential_mass` is the effective mass for a force along the surface, `duration` the contact's duration.
    """
    rig = mechanism.rig
    delay = force_delay(mechanism) + max(axis_lags(mechanism))
    frequency = 1 / (2 * duration) if duration > 0 else math.nan
    warnings = list(unit_warnings(mechanism))
    rate = 1 / rig.control_period
    if frequency > MAX_FREQUENCY_RATIO * rate:
        warnings.append(
            f"contact: found a contact of {frequency:.3g} Hz, expected at most "
            f"{MAX_FREQUENCY_RATIO * rate:.4g} Hz, 1/10 of the control rate"
        )
    limit = math.nan
    for name, contact in mechanism.contact.items():
        friction = contact.friction
        if friction is None or friction.slip is None or not peak_force > 0:
            continue
        # A delayed damper on a mass is stable if damping times delay, divided by the mass, is below pi/2.
        slip = 2 / math.pi * friction.coefficient * peak_force * delay / tangential_mass
        limit = slip if math.isnan(limit) else max(limit, slip)
        if friction.slip < slip:
            warnings.append(
                f"contact.{name}.friction.slip: found {friction.slip:.3g} m/s, "
                f"expected more than {slip:.2g} m/s: below it the delayed friction chatters"
            )
    return SixAxisSummary(effective_mass, frequency, peak_force, restitution, delay, limit, tuple(warnings))
