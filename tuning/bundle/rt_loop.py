"""Real-time loop in C of a one-axis bundle: hand-written files, with the constants of the gain document."""

import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

from jaxhil.rig.flight_recorder import FlightRecorder
from tuning.rig.numerical_model import NumericalModel

FILES = ("rt_loop.h", "rt_loop.c", "rt_log.h", "rt_log.c", "rt_plant_udp.c")
# Displacement of the numerical model in a period, by integrator.
MODEL_STEPS = {
    "semi_implicit_euler": "(PERIOD * (after))",
    "explicit_euler": "(PERIOD * (before))",
    "zoh": "(PERIOD * (before) + PERIOD * PERIOD * (acceleration) / 2.0)",
}


def rt_loop_files(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the text of each file of the real-time loop, by its name.

    Args:
        document: gain document with one axis.
    """
    mechanism, period = document["mechanism"], float(document["control_period"])
    model, sensor = NumericalModel(mechanism), mechanism["rig"].get("force_sensor", {})
    integrator = mechanism["rig"].get("integrator", "semi_implicit_euler")
    has_noise_or_bias = sensor.get("noise_std", 0.0) != 0.0 or sensor.get("bias", 0.0) != 0.0
    recorder = FlightRecorder(period, ticks=1, equivalent_mass=model.mass)
    lines = [
        f"#define PERIOD {period!r} /* s */",
        f"#define EQUIVALENT_MASS {model.mass!r} /* kg, of the numerical model */",
        f"#define START_POSITION ({model.start[0]!r}) /* m, of the model at the start of a run */",
        f"#define START_VELOCITY ({model.start[1]!r}) /* m/s */",
        f"#define HAS_NOISE_OR_BIAS {int(has_noise_or_bias)} /* of the force sensor */",
        "/* Displacement in a period, from the velocities before and after it, and the acceleration. */",
        f"#define MODEL_STEP(before, acceleration, after) {MODEL_STEPS[integrator]}",
        "/* Heading of the log, and its mapping (jaxhil/log/1). */",
        f"#define HEADING {json.dumps(recorder.heading)}",
        "#define MAPPING \\",
        *(f"    {json.dumps(line)} \\" for line in recorder.mapping("*").splitlines(keepends=True)),
        '    ""',
    ]
    folder = resources.files("tuning") / "bundle" / "rt"
    texts = {name: (folder / name).read_text(encoding="utf-8") for name in FILES}
    return {name: text.replace("@constants@", "\n".join(lines)) for name, text in texts.items()}
