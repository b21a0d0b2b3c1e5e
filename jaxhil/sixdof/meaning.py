"""Summary of a six-axis mechanism file: its first ideal contact compared with the abilities of the rig."""

import math
from typing import NamedTuple

from jaxhil.laws.shared.nominal_values import axis_lags
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.sixdof.units import unit_warnings

FASTEST = 0.1  # greatest plausible contact frequency, over the control rate


class Meaning(NamedTuple):
    """Summary of a nominal mechanism's first touch; NaN if nothing touches."""

    effective_mass: float  # m_n [kg]
    frequency: float  # of the ideal contact, 1/(2 duration) [Hz]; NaN if a latch holds at its end
    peak_force: float  # of the ideal contact [N]
    restitution: float  # e* of the ideal contact; NaN unless there is a single touch
    delay: float  # delay of the loop: slowest axis with its lag, and force sensor [s]
    slip_limit: float  # least stable slip of regularised friction on the rig [m/s]; NaN without friction
    warnings: tuple[str, ...]  # implausible numbers: key, found value, expected value

    def line(self, name: str) -> str:
        """Return the summary in one line, without the warnings."""
        if math.isnan(self.effective_mass):
            return f"{name}: nothing touches; the rig is {1e3 * self.delay:.3g} ms late"
        rebound = "" if math.isnan(self.restitution) else f", e* {self.restitution:.3g}"
        kind = "a latch holds" if math.isnan(self.frequency) else f"a contact of {self.frequency:.3g} Hz"
        text = f"{name}: effective mass {self.effective_mass:.4g} kg at the first touch; in space {kind}, "
        text += f"peak force {self.peak_force:.3g} N{rebound}; the rig is {1e3 * self.delay:.3g} ms late"
        if not math.isnan(self.slip_limit):
            text += f", friction steady there from a slip of {self.slip_limit:.2g} m/s on"
        return text


def meaning(
    mechanism: SixAxisMechanism,
    effective_mass: float,
    tangential_mass: float,
    duration: float,
    peak_force: float,
    restitution: float,
) -> Meaning:
    """Return the summary of a mechanism whose first ideal contact has these metrics, in SI units."""
    rig = mechanism.rig
    delay = rig.force_sensor.delay + rig.force_sensor.time_constant + max(axis_lags(mechanism))
    frequency = 1 / (2 * duration) if duration > 0 else math.nan
    warnings = list(unit_warnings(mechanism))
    rate = 1 / rig.control_period
    if frequency > FASTEST * rate:
        warnings.append(
            f"contact: found a contact of {frequency:.3g} Hz, expected at most {FASTEST * rate:.4g} Hz, "
            "1/10 of the control rate"
        )
    limit = math.nan
    for name, contact in mechanism.contact.items():
        friction = contact.friction
        if friction is None or friction.slip is None or not peak_force > 0:
            continue
        # A delayed damper on a mass is stable if damping times delay over mass is below pi/2.
        slip = 2 / math.pi * friction.coefficient * peak_force * delay / tangential_mass
        limit = slip if math.isnan(limit) else max(limit, slip)
        if friction.slip < slip:
            warnings.append(
                f"contact.{name}.friction.slip: found {friction.slip:.3g} m/s, "
                f"expected more than {slip:.2g} m/s: below it the delayed friction chatters"
            )
    return Meaning(effective_mass, frequency, peak_force, restitution, delay, limit, tuple(warnings))
