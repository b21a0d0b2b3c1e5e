"""Logs of a controller on a simple rig in plain Python, as `jaxhil simulate --log` writes them."""

import csv
from pathlib import Path

import numpy as np

from tuning.rig.numerical_model import NumericalModel

NAMES = (
    *("time", "force_measured", "force_command", "position_desired", "velocity_desired", "position_measured"),
    "contact",
)
STIFFNESS = 124355.0  # of `rig-300kg` [N/m]
HARDWARE_LAG, FORCE_LAG = 12, 4  # periods: position behind the command, force behind the position


def record_contacts(make_controller, mechanism, contacts=2, force_lag=FORCE_LAG, ticks=260):
    """Return the columns of a log of `contacts` runs of a controller; in each run the body meets a spring."""
    controller, rows = make_controller(), []
    for contact in range(contacts):
        if contact:
            controller.next_contact()
        model = NumericalModel(mechanism)
        stride = model.velocity * 0.001
        position = [model.position - stride * lag for lag in range(100, -1, -1)]
        controller.position_command(model.position, model.velocity, 0.0)
        for _ in range(ticks):
            measured, pressed = position[-1 - HARDWARE_LAG], position[-1 - HARDWARE_LAG - force_lag]
            force = STIFFNESS * max(pressed, 0.0)
            time, state = 0.001 * len(rows), (model.position, model.velocity)
            command = controller.step(force, *state, measured, time)
            rows.append((time, force, command, *state, measured, float(contact)))
            model.integrate(command)
            position.append(controller.position_command(model.position, model.velocity, model.acceleration))
    return dict(zip(NAMES, np.array(rows).T, strict=True))


def write_columns(path: Path, columns, form=repr) -> Path:
    """Write columns to a CSV file; `form` formats a number."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([form(float(value)) for value in row] for row in zip(*columns.values(), strict=True))
    return path
