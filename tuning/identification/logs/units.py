"""Units of logged values, and their factors to SI units."""

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
SPEED_UNITS = {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6, "in/s": 0.0254}
FORCE_UNITS = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "lbf": 4.4482216152605}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
COUNTS_UNIT = "counts"  # unit of raw sensor counts; the channel's `scale` converts one count to SI units

# Allowed units of each numeric channel, with the SI unit first.
UNITS_OF_CHANNEL = {
    "time": TIME_UNITS,
    "position_desired": LENGTH_UNITS,
    "position_measured": LENGTH_UNITS,
    "force_measured": FORCE_UNITS,
    "velocity_desired": SPEED_UNITS,
    "force_command": FORCE_UNITS,
}
