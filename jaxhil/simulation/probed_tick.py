"""Effects of the probe at a tick: push on the hardware, and deviation of the model from the ideal contact."""

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
    """Add the effects of the probe to the state, the contact and the watch of a tick.

    Args:
        rig: Constants of the run.
        probe: Probe of the current contact.
        state: State of the loop.
        over: Whether the contact ended before this tick.
        signals: Inputs of the compensator at this tick.
        sample: Motion of the hardware at the instant at which the force is sampled.
        contact: Real contact in the sampling interval.
        watch: Record of the current contact.
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
    """Add the push to the force on the hardware and to the reading of the force sensor."""
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
    """Add the numerical model's deviation from the ideal contact, unless the contact is `over`."""
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
