"""Real-time loop in C of a bundle: hand-written files, with the constants of the gain document."""

import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

from jaxhil.rig.flight_recorder import FlightRecorder
from tuning.bundle.controller_kind import ONE_AXIS, kind_of
from tuning.rig.numerical_model import NOISE_AND_BIAS_KEYS, NumericalModel
from tuning.rig.numerical_model_six_axes import BODY_NUMBERS, SHARES, build_body

# Files of the loop, and the sources of its numerical model by number of axes.
FILES = (
    *("rt_loop.h", "rt_loop.c", "rt_task.h", "rt_task.c", "rt_model.h"),
    *("rt_log.h", "rt_log.c", "rt_plant_udp.c"),
)
MODEL_SOURCES = {
    1: {"rt_model.c": "rt/rt_model_one_axis.c"},
    6: {"rt_model.c": "rt/rt_model_six_axes.c", "numerical_model.h": "fmu/c/numerical_model_six_axes.h"},
}
# Displacement of the one-axis numerical model in a period, by integrator.
MODEL_STEPS = {
    "semi_implicit_euler": "(PERIOD * (after))",
    "explicit_euler": "(PERIOD * (before))",
    "zoh": "(PERIOD * (before) + PERIOD * PERIOD * (acceleration) / 2.0)",
}


def rt_loop_files(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the text of each file of the real-time loop, by its name.

    Args:
        document: gain document.
    """
    kind, mechanism, period = kind_of(document), document["mechanism"], float(document["control_period"])
    integrator = mechanism["rig"].get("integrator", "semi_implicit_euler")
    model = NumericalModel(mechanism) if kind is ONE_AXIS else None
    if model is None:
        constants = _six_axis_constants(mechanism, integrator)
    else:
        constants = _one_axis_constants(mechanism, model, integrator)
    mass = None if model is None else model.mass
    recorder = FlightRecorder(period, kind.axes, ticks=1, equivalent_mass=mass)
    lines = [
        f"enum {{ AXES = {kind.axes} }};",
        f"#define PERIOD {period!r} /* s */",
        *constants,
        "/* Heading of the log, and its mapping (jaxhil/log/1). */",
        f"#define HEADING {json.dumps(recorder.heading)}",
        "#define MAPPING \\",
        *(f"    {json.dumps(line)} \\" for line in recorder.mapping("*").splitlines(keepends=True)),
        '    ""',
    ]
    folder = resources.files("tuning") / "bundle"
    sources = {**{name: f"rt/{name}" for name in FILES}, **MODEL_SOURCES[kind.axes]}
    texts = {name: (folder / source).read_text(encoding="utf-8") for name, source in sources.items()}
    return {name: text.replace("@constants@", "\n".join(lines)) for name, text in texts.items()}


def _one_axis_constants(mechanism: Mapping[str, Any], model: NumericalModel, integrator: str) -> list[str]:
    """Return the C constants of the numerical model with one axis."""
    sensor = mechanism["rig"].get("force_sensor", {})
    has_noise_or_bias = any(sensor.get(key, 0.0) != 0.0 for key in NOISE_AND_BIAS_KEYS)
    return [
        "enum { START_VALUES = 2 };",
        f"#define EQUIVALENT_MASS {model.mass!r} /* kg, of the numerical model */",
        f"#define START_POSITION ({model.start[0]!r}) /* m, of the model at the start of a run */",
        f"#define START_VELOCITY ({model.start[1]!r}) /* m/s */",
        f"#define HAS_NOISE_OR_BIAS {int(has_noise_or_bias)} /* of the force sensor */",
        "/* Displacement in a period, from the velocities before and after it, and the acceleration. */",
        f"#define MODEL_STEP(before, acceleration, after) {MODEL_STEPS[integrator]}",
    ]


def _six_axis_constants(mechanism: Mapping[str, Any], integrator: str) -> list[str]:
    """Return the C constants of the numerical model with six axes."""
    return [
        f"enum {{ START_VALUES = {2 * BODY_NUMBERS} }};",
        f"#define VELOCITY_SHARE {SHARES[integrator]!r} /* of the velocity change that moves the body */",
        "/* Target and chaser: mass, inverse inertia, origin and attitude of the interface frame. */",
        f"#define BODIES {body_constants(mechanism)}",
    ]


def body_constants(mechanism: Mapping[str, Any]) -> str:
    """Return the C initialiser of target and chaser in the numerical model with six axes."""
    bodies = []
    for name in ("target", "chaser"):
        mass, *vectors = build_body(mechanism[name])
        bodies.append(f"{{{mass!r}, {', '.join(map(_initialiser, vectors))}}}")
    return f"{{ \\\n    {bodies[0]}, \\\n    {bodies[1]}}}"


def _initialiser(values: Any) -> str:
    """Return the C initialiser of nested sequences of numbers."""
    if isinstance(values, float):
        return repr(values)
    return f"{{{', '.join(map(_initialiser, values))}}}"
