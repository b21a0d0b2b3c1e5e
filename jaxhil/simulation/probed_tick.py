"""Tick of a probed run: the push on the hardware, and the comparison with the ideal contact."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.contact.laws import deflection
from jaxhil.laws.simulation_base import KnownConstants, Signals
from jaxhil.simulation.contact_force import IntervalContact, MotionSample
from jaxhil.simulation.loop import RigConstants
from jaxhil.simulation.loop_state import LoopState
from jaxhil.simulation.probe import FirstContact, Probe, update_deviation, update_first_contact
from jaxhil.simulation.watch import Watch


def apply_probe(
    rig: RigConstants,
    probe: Probe,
    state: LoopState,
    over: Array,
    signals: Signals,
    sample: MotionSample,
    contact: IntervalContact,
    watch: Watch,
) -> tuple[LoopState, IntervalContact, Watch]:
    """Return state, contact and watch of a tick, including the probe.

    `sample` is the motion at the force's sampling instant; `over` says whether the contact ended before this
    tick.
    """
    first_contact, contact = apply_push(rig, probe, state.first_contact, signals.age, sample, contact)
    watch = update_model_deviation(rig.constants, probe, over, signals, watch)
    return state._replace(first_contact=first_contact), contact, watch


def apply_push(
    rig: RigConstants,
    probe: Probe,
    first_contact: FirstContact | None,
    age: Array,
    sample: MotionSample,
    contact: IntervalContact,
) -> tuple[FirstContact, IntervalContact]:
    """Push the hardware according to the time since its first touch; the force sensor reads the push too."""
    assert first_contact is not None
    scenario, period = rig.scenario, rig.constants.control_period
    signed = deflection(sample.position, scenario.clearance)
    side = jnp.sign(signed)
    now = age.astype(period.dtype)
    first = update_first_contact(first_contact, side * signed, side * sample.velocity, side, now, period)
    since = jnp.where(first.made, now - first.time, -1e9) * period
    force = contact.plant_signals.force + first.side * probe.push.force(since)
    reading = contact.reading
    if reading is not None:
        reading = reading + first.side * probe.push.lagged(since, scenario.force_sensor.time_constant)
    return first, contact._replace(plant_signals=contact.plant_signals._replace(force=force), reading=reading)


def update_model_deviation(
    constants: KnownConstants, probe: Probe, over: Array, signals: Signals, watch: Watch
) -> Watch:
    """Compare x_d with the ideal contact, until the contact is `over`."""
    assert watch.deviation is not None
    depth, rate = signals.position_desired, signals.velocity_desired
    if watch.side is not None:
        depth = jnp.where(watch.side > 0, depth, -constants.clearance - depth)
        rate = watch.side * rate
    now = signals.age.astype(rate.dtype)
    deviation = update_deviation(
        watch.deviation, probe.depth, probe.span, depth, rate, now, constants.control_period, ~over
    )
    return watch._replace(deviation=deviation)
