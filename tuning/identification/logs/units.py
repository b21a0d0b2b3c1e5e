"""Units of logged values, and their factors to SI units."""

LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
SPEED = {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6, "in/s": 0.0254}
FORCE = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "lbf": 4.4482216152605}
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
COUNTS = "counts"  # the channel's `scale` is the value of one count in SI units

# Units of each numeric channel; the first one is the SI unit.
OF_CHANNEL = {
    "time": TIME,
    "position_desired": LENGTH,
    "position_measured": LENGTH,
    "force_measured": FORCE,
    "velocity_desired": SPEED,
    "force_command": FORCE,
}
