"""Log files of simulated campaigns with known true parameters, and the mapping of their columns."""

import numpy as np

MAPPING = """schema = "jaxhil/log/1"

[channels]
time = { column = "Time [ms]", unit = "ms" }
position_desired = { column = "Command [mm]", unit = "mm" }
position_measured = { column = "Position [mm]", unit = "mm" }
force_measured = { column = "Force [kN]", unit = "kN" }
force_command = "Fc [N]"
velocity_desired = { column = "vd [mm/s]", unit = "mm/s" }

[timing]
control_period = 0.001

[bodies]
equivalent_mass = 350.0
"""


def columns(run, jitter=0.0, random=None):
    """Return the columns of a run's log file by name, without lost rows."""
    late = 0.0
    if random is not None:
        late = np.clip(jitter * random.standard_normal(len(run.tick)), -4.5e-4, 4.5e-4)
    every = {
        "Time [ms]": 1e3 * (7.0 + 1e-3 * run.tick + late),
        "Command [mm]": 1e3 * run.position_desired,
        "Position [mm]": 1e3 * run.position_measured,
        "Force [kN]": None if run.force_measured is None else 1e-3 * run.force_measured,
        "Fc [N]": run.force_command,
        "vd [mm/s]": None if run.velocity_desired is None else 1e3 * run.velocity_desired,
    }
    return {name: one[run.valid] for name, one in every.items() if one is not None}


def write_columns(path, table):
    rows = np.stack(list(table.values()), axis=1)
    np.savetxt(path, rows, "%.15g", ",", header=",".join(table), comments="")


def write(folder, campaign, jitter=0.0):
    """Write a log file for every run."""
    random = np.random.default_rng(0)
    for number, run in enumerate(campaign.runs):
        write_columns(folder / f"{run.kind}_{number:02}.csv", columns(run, jitter, random))


def logs(folder):
    return sorted(folder.glob("*.csv"))
