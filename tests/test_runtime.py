"""Runtime controller over several runs: repeatability, reset, trips, and standalone use."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from gain_documents import GAINS, gain_document, sign
from runtime_readings import readings, run

import jaxhil.rig
from jaxhil.rig import Controller

RUNTIME = Path(jaxhil.rig.__file__).parent


@pytest.mark.parametrize("name", sorted(GAINS))
def test_controller_repeats_runs_bit_for_bit_after_reset(name):
    ticks = readings(300)
    controller = Controller.from_dict(gain_document(name))
    first = run(controller, ticks)
    controller.reset()
    again = run(controller, ticks)
    fresh = run(Controller.from_dict(gain_document(name)), ticks)
    assert [value.hex() for value in first] == [value.hex() for value in again]
    assert [value.hex() for value in first] == [value.hex() for value in fresh]
    assert all(type(value) is float for value in first)


def test_controller_returns_same_floats_for_numpy_scalars_and_integers():
    ticks = readings(200)
    document = gain_document()
    plain = run(Controller.from_dict(document), ticks)
    controller = Controller.from_dict(document)
    scalars = [controller.step(*np.array(tick)) for tick in ticks]
    assert scalars == plain
    assert all(type(value) is float for value in scalars)


def test_reset_clears_identification_and_next_contact_keeps_identification():
    ticks = readings(300)
    controller = Controller.from_dict(gain_document())
    run(controller, ticks)
    stiffness, damping = controller.identified
    assert stiffness != 8e4

    controller.next_contact()
    assert controller.identified == (stiffness, damping)
    continued = run(controller, ticks)
    # Only the identified parameters persist, as if they had been the initial ones.
    document = gain_document()
    document["gains"]["initial_stiffness"]["value"] = stiffness
    document["gains"]["initial_damping"].update(value=damping, lower=-1e6)
    assert continued == run(Controller.from_dict(sign(document)), ticks)

    controller.reset()
    assert controller.identified == (8e4, 50.0)


@pytest.mark.parametrize("name", sorted(GAINS))
@pytest.mark.parametrize("position", range(5))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_controller_trips_on_nonfinite_input_until_reset(name, position, value):
    controller = Controller.from_dict(gain_document(name))
    readings = (100.0, 1e-3, 0.0, 1e-3)
    healthy = controller.step(*readings, 0.0)
    assert healthy != 0.0
    bad = [*readings, 0.001]
    bad[position] = value
    names = ["force_measured", "position_desired", "velocity_desired", "position_measured", "time"]
    fault = ["force_not_finite", "model_not_finite", "model_not_finite", "position_not_finite", "clock"]
    assert controller.step(*bad) == 0.0
    assert controller.status == f"tripped: {fault[position]} ({names[position]} is {value!r})"
    assert controller.step(*readings, 0.002) == 0.0
    controller.next_contact()
    assert controller.step(*readings, 0.003) == 0.0
    assert controller.status.startswith("tripped: ")
    assert controller.reset()
    assert controller.status == "ok"
    assert controller.step(*readings, 0.004) == healthy


def test_controller_trips_on_input_that_is_not_a_number():
    controller = Controller.from_dict(gain_document())
    assert controller.step(None, 0.0, 0.0, 0.0) == 0.0  # type: ignore[arg-type]
    assert controller.status == "tripped: force_not_finite (force_measured is null)"


def test_controller_trips_on_force_that_overflows():
    controller = Controller.from_dict(gain_document("virtual_contact"))
    assert controller.step(0.0, 1e-3, 1.7e308, 0.0) == 0.0
    assert controller.status == "tripped: command_not_finite"


def test_controller_trips_and_holds_position_on_nonfinite_position_command():
    controller = Controller.from_dict(gain_document())
    assert controller.position_command(-0.02, 0.005, 0.0) == -0.02
    assert controller.position_command(math.nan, 0.005, 0.0) == -0.02
    assert controller.status == "tripped: model_not_finite (the numerical model's motion)"
    assert controller.step(10.0, 0.0, 0.0, 0.0) == 0.0


def test_controller_counts_missed_ticks():
    controller = Controller.from_dict(gain_document("none"))
    for time in (0.0, 0.001, 0.0024, 0.0034, 0.0054, 0.0094):
        controller.step(1.0, 0.0, 0.0, 0.0, time)
    # Gaps of 1, 1.4, 1, 2 and 4 periods.
    assert controller.missed_ticks == 4
    controller.next_contact()
    controller.step(1.0, 0.0, 0.0, 0.0, 5.0)
    assert controller.missed_ticks == 4
    controller.step(1.0, 0.0, 0.0, 0.0)
    controller.reset()
    assert controller.missed_ticks == 0


def test_several_controllers_share_no_state():
    ticks = readings(200)
    alone = run(Controller.from_dict(gain_document()), ticks)
    first, second = Controller.from_dict(gain_document()), Controller.from_dict(gain_document())
    interleaved = []
    for tick in ticks:
        interleaved.append(first.step(*tick))
        second.step(50.0, 1e-3, 0.1, 2e-3)
    assert interleaved == alone


def test_controller_runs_with_the_standard_library_alone(tmp_path):
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(gain_document()))
    program = f"""
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names | {{"jaxhil"}}:
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Blocker())
sys.path.insert(0, {str(RUNTIME.parents[1])!r})
from jaxhil.rig import Controller
controller = Controller.from_file({str(path)!r})
print(repr(controller.step(100.0, 1e-3, 0.0, 1e-3)))
"""
    shown = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", program],
        capture_output=True,
        text=True,
        check=True,
    )
    expected = Controller.from_dict(gain_document()).step(100.0, 1e-3, 0.0, 1e-3)
    assert float(shown.stdout) == expected
    assert shown.stderr == ""


def test_former_package_name_can_still_be_imported():
    program = (
        "import warnings\nwarnings.simplefilter('ignore')\n"
        "import jaxhil.runtime, jaxhil.rig\nfrom jaxhil.runtime import Controller\n"
        "from jaxhil.runtime.registry import COMPENSATORS\n"
        "assert Controller is jaxhil.rig.Controller and COMPENSATORS is jaxhil.rig.COMPENSATORS\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
