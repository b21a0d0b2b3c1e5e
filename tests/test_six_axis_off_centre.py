"""Six-axis impulse ledger off the centre line, compared with one axis at the effective mass."""

import numpy as np
import pytest
from test_six_axis_runs import central_contact

import jaxhil as package
from jaxhil.mechanism.file import any_from_plain_data
from jaxhil.sixdof.run import simulate_six_axes

NAME, ARM = "claw-350kg", np.array([0.4, -0.3, 0.0])  # contact from the centre line [m]
INERTIA = np.array([300.0, 250.0, 200.0])  # kg m^2


@pytest.mark.slow
@pytest.mark.users_options
def test_off_centre_contact_without_friction_equals_one_axis_with_effective_mass():
    """Compare restitutions without compensation and with the ledgers of six axes and of one axis."""
    one_axis, raw = central_contact(NAME)
    raw["contact"]["nose"]["chaser"]["centre"] = ARM.tolist()
    for body in ("target", "chaser"):
        raw[body]["inertia"] = INERTIA.tolist()
    off_centre = any_from_plain_data(raw, NAME)
    mass = 1 / (1 / one_axis.bodies.mass + 2 * np.sum(np.cross(ARM, [0, 0, 1]) ** 2 / INERTIA))
    central = package.load(NAME, {"bodies.equivalent_mass": mass, "approach.contacts": 1})
    for law in ("none", "impulse_ledger"):
        [result] = simulate_six_axes(off_centre, law).episodes
        [expected] = package.simulate(central, law).contacts
        assert result.effective_mass == pytest.approx(mass, rel=1e-9)
        assert result.restitution == pytest.approx(expected.restitution, rel=0.05)
