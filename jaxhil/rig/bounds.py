"""Absolute bounds of gains and limits, which no gain file can widen.

The bounds admit every rig with these properties:

    control period              10 us to 0.1 s
    equivalent mass M           10 g to 1000 t
    contact frequency           0.05 to 50 Hz
    approach speed              10 um/s to 10 m/s
    delays                      at most 1 s in the force measurement, and 1 s in the motion simulator
    force, noise and dead zone  together below 1 MN
    positions                   within 50 m of the surface (rendezvous rigs have rails of about 25 m)
    speed of position command   below 10 m/s

The bounds are slightly wider than the gains of published rules, of tuning and of the built-in settings for
such a rig. `jaxhil/laws` has narrower bounds for a specific rig. The bounds are:

    times           2 x (1 s + 1 s) + 0.02 s, twice the loop's delay, the largest lead that tuning tries
    stiffness       5 M omega^2 = 5e11 N/m for 1000 t at 50 Hz
    damping         4 M omega = 1.3e9 N s/m for 1000 t at 50 Hz
    stiffness / M   omega^2 = 1e5/s^2 at 50 Hz
    damping / M     2 omega = 630/s at 50 Hz
    mass            a tenth of M to ten times M

If a gain file does not set a limit, these bounds apply: a force above 1 MN, a position command beyond 50 m
or a command that changes faster than 10 m/s trips the controller.
"""

# Each pair below contains the lowest and the highest value.
CONTROL_PERIODS = 1e-5, 0.1  # [s]
TIMES = 0.0, 4.1  # [s]
FILTER_TIMES = 1e-6, 2.1  # bounds of filters' time constants [s]; a filter with 0 would divide by 0 or ring
FORCES = 0.0, 1e6  # [N]
STIFFNESSES = 0.0, 1e12  # [N/m]
DAMPINGS = 0.0, 1e11  # [N s/m]
STIFFNESSES_BY_MASS = 0.0, 1e5  # [1/s^2]
DAMPINGS_BY_MASS = 0.0, 1e3  # [1/s]
MASSES = 1e-3, 1e7  # [kg]
DISTANCES = 0.0, 10.0  # [m]
POSITIONS = -50.0, 50.0  # [m]
SPEEDS = 0.0, 10.0  # [m/s]
# The upper bound has no effect: the force may cross its whole range within the shortest period.
FORCE_SLEWS = 0.0, 1e12  # [N/s]
DECELERATIONS = 1e-6, 1e7  # [m/s^2]


def format_range(lowest: float, highest: float) -> str:
    """Return the text "LOWEST to HIGHEST" for an error message."""
    return f"{lowest!r} to {highest!r}"
