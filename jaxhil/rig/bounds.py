"""Absolute bounds of gains and limits, which no gain file can widen.

They admit any rig with a control period of 10 us to 0.1 s and an equivalent mass of 10 g to 1000 t, whose
contact has a frequency of 0.05 to 50 Hz and begins at 10 um/s to 10 m/s. Force measurement and motion
simulator are each late by at most 1 s. Contact force, noise and dead zone together stay below 1 MN, positions
within 50 m of the surface (rails of rendezvous rigs are half as long), speeds of the position command below
10 m/s. The bounds contain all gains that the literature's rules, tuning and the shipped settings yield for
such a rig, and little more (`jaxhil/laws` has narrower bounds for a given rig):

    times       2 x 1 s + 0.02 s, the largest lead and alignment that tuning tries
    stiffness   5 M omega^2 = 5e11 N/m for 1000 t at 50 Hz
    damping     4 M omega = 1.3e9 N s/m for 1000 t at 50 Hz
    by mass     omega^2 = 1e5/s^2 and 2 omega = 630/s at 50 Hz
    mass        a tenth of the rig's mass to ten times as much

Where a gain file sets no limit, these bounds apply: a force beyond 1 MN, a position command beyond 50 m or
one that changes faster than 10 m/s trips the controller.
"""

CONTROL_PERIODS = 1e-5, 0.1  # [s]; lowest and highest value, as in all pairs below
TIMES = 0.0, 2.1  # [s]
FILTER_TIMES = 1e-6, 2.1  # [s]; for filters that would divide by 0 or ring with a time constant of 0
FORCES = 0.0, 1e6  # [N]
STIFFNESSES = 0.0, 1e12  # [N/m]
DAMPINGS = 0.0, 1e11  # [N s/m]
STIFFNESSES_BY_MASS = 0.0, 1e5  # [1/s^2]
DAMPINGS_BY_MASS = 0.0, 1e3  # [1/s]
MASSES = 1e-3, 1e7  # [kg]
DISTANCES = 0.0, 10.0  # [m]
POSITIONS = -50.0, 50.0  # [m]
SPEEDS = 0.0, 10.0  # [m/s]
# The upper bound does not limit: it lets the force cross its whole range within the shortest period.
FORCE_SLEWS = 0.0, 1e12  # [N/s]
DECELERATIONS = 1e-6, 1e7  # [m/s^2]


def format_range(lowest: float, highest: float) -> str:
    """Return the range as text for an error message."""
    return f"{lowest!r} to {highest!r}"
