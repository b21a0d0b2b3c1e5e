"""Controller of a six-axis rig in free flight, with the limits of the test documents."""

from six_axis_documents import LIMITS, six_axis_document

from jaxhil.rig.faults import fault_names
from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS

PERIOD = 1e-3
ZERO = [0.0] * 6
START = [0.01, -0.02, 0.05, 0.01, 0.0, -0.01]
TWIST = [0.001, 0.0, -0.02, 0.002, 0.0, 0.0]


def controller(compensator="impulse_ledger", **limits):
    return Controller6.from_dict(six_axis_document(compensator, limits={**LIMITS, **limits}))


def along(tick, pose=START, twist=TWIST):
    """Return the pose at a tick of uniform motion."""
    return [at + tick * PERIOD * rate for at, rate in zip(pose, twist, strict=True)]


def fly(rig, ticks, first=0, wrench=ZERO, timed=False):
    """Run ticks of free flight; return the pose commands."""
    sent = []
    for tick in range(first, first + ticks):
        now = along(tick)
        rig.step(wrench, now, TWIST, now, tick * PERIOD if timed else None)
        sent.append(rig.pose_command(along(tick + 1), TWIST, ZERO))
    return sent


def names(rig):
    return fault_names(rig.cause, SIX_AXIS_FAULTS)
