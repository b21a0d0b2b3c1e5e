"""Mechanism `rig-300kg` with changed values."""

import jaxhil

MASS, STIFFNESS, SPEED = 300.0, 106592.0, 0.005  # values of rig-300kg


def rig(overrides=(), **others):
    """Return rig-300kg with the values at dotted paths replaced; a keyword `a__b` stands for the path a.b."""
    named = {path.replace("__", "."): value for path, value in others.items()}
    return jaxhil.load("rig-300kg", {**dict(overrides), **named})


def behind(**simulator):
    return rig({"rig.simulator": simulator, "uncertainty": {}})
