"""Numerical model in the controller's FMU with six axes: motion of both bodies, as in the Python process."""

import numpy as np
import pytest
from fmus import RunningFmu, extract, part_names, write_fmu
from scipy.spatial.transform import Rotation
from test_fmu_rig_six_axes import document_of

from jaxhil.rig.six_axes import Controller6
from tuning.bundle.fmu.controller import controller_fmu
from tuning.rig.numerical_model_six_axes import SixAxisModelInLoop, build_body

# Rotations of the interface frames T and C, which the built-in mechanism does not have [rad].
ROTATED = ("target.interface_rotation=[0.3, -0.2, 0.5]", "chaser.interface_rotation=[-0.1, 0.4, 0.2]")
INPUTS = ("pose_desired", "twist_desired", "target_angular_velocity")
OUTPUTS = ("model_pose", "model_twist", "pose_command", "wrench_command")


def rotation(w, x, y, z):
    return Rotation.from_quat([x, y, z, w])


def draw_start(mechanism, draw):
    """Return random states of both bodies (26,), and the angular velocity of the target in axes of T."""
    states = np.zeros((2, 13))
    states[:, :6] = 0.005 * draw((2, 6))
    states[1, :3] += np.subtract(mechanism["target"]["interface"], mechanism["chaser"]["interface"])
    states[:, 6:10] = [Rotation.from_rotvec(0.02 * draw(3)).as_quat()[[3, 0, 1, 2]] for _ in states]
    states[:, 10:] = 3.0 * draw((2, 3))
    target = build_body(mechanism["target"])
    in_body = np.array(target.inverse_inertia) @ rotation(*states[0, 6:10]).inv().apply(states[0, 10:])
    return states.ravel().tolist(), rotation(*target.interface_attitude).inv().apply(in_body)


def values_of(vectors, numbers):
    names = [name for vector in vectors for name in part_names(vector)]
    return dict(zip(names, np.concatenate(numbers).tolist(), strict=True))


@pytest.mark.slow
def test_six_axis_fmu_integrates_motion_of_both_bodies_with_a_turning_target(tmp_path):
    made = document_of("probe-drogue", "impulse_ledger", ROTATED)
    fmu = RunningFmu(extract(write_fmu(tmp_path / "controller.fmu", controller_fmu(made, 3))))
    controller = Controller6.from_dict(made)
    model, rng = SixAxisModelInLoop(controller, made["mechanism"]), np.random.default_rng(1)

    def begin_run(**events):
        states, angular = draw_start(made["mechanism"], rng.standard_normal)
        assert model.place(states)
        return values_of(INPUTS, (*model.motion, angular)) | events

    def outputs_after(wrench, pose, time, **events):
        inputs = values_of(("wrench_measured", "pose_measured"), (wrench, pose))
        fmu.set(inputs | {"next_contact": False, "has_tick_time": True, "tick_time": time} | events)
        fmu.step()
        return fmu.get(*expected())

    def expected():
        return values_of(OUTPUTS, (*model.motion, model.command, model.force))

    def approximately(values):
        return pytest.approx(values, rel=1e-9, abs=1e-10)

    fmu.reset(integrates_model=True, **begin_run())
    model.begin()
    assert fmu.get(*expected()) == approximately(expected())
    for tick in range(100):
        events, state = {}, fmu.instance.getFMUState()
        if tick == 60:
            controller.next_contact()
            events = begin_run(next_contact=True)
        wrench, pose, time = 5.0 * rng.standard_normal(6), model.motion[0], fmu.period * tick
        model.tick(tick, wrench.tolist(), pose, time)
        first = outputs_after(wrench, pose, time, **events)
        assert first == approximately(expected()), tick
        fmu.instance.setFMUState(state)
        assert outputs_after(wrench, pose, time, **events) == first
        fmu.instance.freeFMUState(state)
    assert not controller.tripped
    fmu.close()
