"""Six-axis motion compared with MuJoCo: a free top, one tether, three tethers. Skipped without `mujoco`.

A tether is slack up to its length and a spring beyond: a tendon with a dead band in MuJoCo, and here a point
of the chaser in a sphere on the target. Contacts of MuJoCo are not comparable: their stiffness is not
specified in N/m.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from six_axes import FULL, lanes, place, plain_body, spheres, springs

from jaxhil.sixdof.bodies import angular_velocity, build_state
from jaxhil.sixdof.ideal_contact_integration import (
    IdealContactModel,
    error_speed,
    integrate_until,
    start_integration,
)
from jaxhil.sixdof.relative import Pair, States
from jaxhil.sixdof.rotations import identity
from jaxhil.sixdof.shapes import Cavity
from jaxhil.sixdof.vectors import components, vector

mujoco = pytest.importorskip("mujoco")
pytestmark = pytest.mark.slow
BATCH, DURATION, STEP = (1,), 0.5, 1e-5  # s
MASSES, LENGTH, STIFFNESS = (1800.0, 420.0), 0.5, 2e4
PLACES = ((0.0, 0.0, 0.0), (0.1, -0.05, 2.6))
VELOCITIES = ((0.0, 0.0, 0.0), (0.02, 0.01, 0.05))
ANGULAR = ((0.01, -0.02, 0.005), (-0.03, 0.02, 0.05))
# Ends of the tethers relative to the centres of mass of target and chaser.
ENDS = [
    ((0.3, 0.1, 1.0), (0.32, 0.12, -1.1187)),
    ((-0.4, 0.2, 0.9), (-0.5, 0.2, -1.2055)),
    ((0.1, -0.5, 1.1), (0.1, -0.45, -1.0132)),
]


@pytest.mark.parametrize("tethers", [0, 1, 3])
def test_six_axis_twists_agree_with_mujoco(tethers):
    duration = DURATION if tethers else 5.0
    result, expected = simulate_tethers(tethers, duration), mujocos(tethers, duration)
    assert (expected[5] < 0.03) == (tethers > 0)  # the chaser's velocity along z, 0.05 m/s without tethers
    np.testing.assert_allclose(result, expected, atol=1e-7 * np.max(np.abs(expected)))


def simulate_tethers(tethers, duration):
    """Return velocities of both bodies (world axes), then angular velocities (body axes)."""
    bodies = Pair(*(
        plain_body(mass, inertia, (0, 0, 0), BATCH) for mass, inertia in zip(MASSES, FULL, strict=True)
    ))  # fmt: skip
    level = identity(jnp.zeros(BATCH))
    motions = zip(bodies, PLACES, VELOCITIES, ANGULAR, strict=True)
    start = States(*(
        build_state(body, place(r, BATCH), place(v, BATCH), level, place(w, BATCH))
        for body, r, v, w in motions
    ))  # fmt: skip
    groups = ()
    if tethers:
        one = jnp.ones((tethers, 1))
        target, chaser = (lanes(np.array(ends).T, BATCH) for ends in zip(*ENDS[:tethers], strict=True))
        shape = Cavity(vector(target), LENGTH * one)
        groups = (spheres(chaser, 0 * one, shape, "hunt_crossley", springs(STIFFNESS * one, 0 * one, one)),)
    contact_model = IdealContactModel(bodies, groups, ())
    time, longest = lanes(duration, BATCH), lanes(1e-3, BATCH)

    @jax.jit
    def flown():
        return integrate_until(
            contact_model,
            start_integration(contact_model, start, longest),
            time,
            longest,
            error_speed(contact_model, start),
        ).states

    end = flown()
    turning = [angular_velocity(*one) for one in zip(bodies, end, strict=True)]
    result = [*(state.velocity for state in end), *turning]
    return np.concatenate([np.asarray(components(one))[:, 0] for one in result])


def mujocos(tethers, duration):
    def body(name, index):
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = FULL[index]
        sites = "".join(
            f'<site name="{name}{number}" pos="{said(ends[index])}"/>' for number, ends in enumerate(ENDS)
        )
        return f"""<body name="{name}" pos="{said(PLACES[index])}"><freejoint/>{sites}
            <inertial pos="0 0 0" mass="{MASSES[index]}" fullinertia="{said((xx, yy, zz, xy, xz, yz))}"/>
            </body>"""

    tendons = "".join(
        f"""<spatial stiffness="{STIFFNESS}" springlength="0 {LENGTH}">
            <site site="target{number}"/><site site="chaser{number}"/></spatial>"""
        for number in range(tethers)
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option gravity="0 0 0" integrator="RK4" timestep="{STEP if tethers else 1e-4}"/>
            <worldbody>{body("target", 0)}{body("chaser", 1)}</worldbody>
            <tendon>{tendons}</tendon></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qvel = [*VELOCITIES[0], *ANGULAR[0], *VELOCITIES[1], *ANGULAR[1]]
    for _ in range(round(duration / model.opt.timestep)):
        mujoco.mj_step(model, data)
    moving = np.array(data.qvel).reshape(2, 2, 3)
    return np.concatenate([moving[0, 0], moving[1, 0], moving[0, 1], moving[1, 1]])


def said(numbers):
    return " ".join(map(repr, map(float, numbers)))
