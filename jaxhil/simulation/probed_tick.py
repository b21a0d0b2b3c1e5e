"""Effects of the probe at a tick: push on the hardware, and deviation of the model from the ideal contact."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.contact.laws import deflection
from jaxhil.laws.simulation_base import KnownConstants, Signals
from jaxhil.mechanism.sensor_filter import FilterModes
from jaxhil.simulation.contact_force import IntervalContact, MotionSample
from jaxhil.simulation.contact_tracking import ContactTracker
from jaxhil.simulation.loop import RigConstants
from jaxhil.simulation.loop_state import LoopState
from jaxhil.simulation.probe import FirstContact, Probe, update_deviation, update_first_contact


def apply_probe(
    rig: RigConstants,
    probe: Probe,
    state: LoopState,
    has_ended: Array,
    signals: Signals,
    sample: MotionSample,
    contact: IntervalContact,
    tracker: ContactTracker,
    sensor_filter: FilterModes | None = None,
) -> tuple[LoopState, IntervalContact, ContactTracker]:
    """Apply the probe of a test: add its push to the contact, and record the model's deviation.

    Args:
        rig: Constants of the run.
        probe: Push in the current contact, and ideal contact from which the deviation is measured.
        state: State of the loop.
        has_ended: Whether the contact ended before this tick.
        signals: Inputs of the compensator at this tick.
        sample: Motion of the hardware at the instant at which the force is sampled.
        contact: Real contact in the sampling interval.
        tracker: Record of the current contact.
        sensor_filter: Modes of the force sensor's filter; None without a filter.
    """
    first_contact, contact = apply_push(
        rig, probe, state.first_contact, signals.age, sample, contact, sensor_filter
    )
    tracker = update_model_deviation(rig.constants, probe, has_ended, signals, tracker)
    return state._replace(first_contact=first_contact), contact, tracker


def apply_push(
    rig: RigConstants,
    probe: Probe,
    first_contact: FirstContact | None,
    age: Array,
    sample: MotionSample,
    contact: IntervalContact,
    sensor_filter: FilterModes | None = None,
) -> tuple[FirstContact, IntervalContact]:
    """Add the probe's push, a test force on the hardware, to the real force and to the sensor's reading."""
    assert first_contact is not None
    scenario, period = rig.scenario, rig.constants.control_period
    signed = deflection(sample.position, scenario.clearance)
    side = jnp.sign(signed)
    now = age.astype(period.dtype)
    first = update_first_contact(first_contact, side * signed, side * sample.velocity, side, now, period)
    since = jnp.where(first.made, now - first.time, -1e9) * period
    force = contact.plant_signals.force + first.side * probe.push.force(since)
    reading = contact.reading
    if reading is not None and sensor_filter is not None:
        cutoff = scenario.force_sensor.cutoff
        reading = reading + first.side * probe.push.filtered(since, sensor_filter, cutoff)
    elif reading is not None:
        reading = reading + first.side * probe.push.lagged(since, scenario.force_sensor.time_constant)
    return first, contact._replace(plant_signals=contact.plant_signals._replace(force=force), reading=reading)


def update_model_deviation(
    constants: KnownConstants, probe: Probe, has_ended: Array, signals: Signals, tracker: ContactTracker
) -> ContactTracker:
    """Record the numerical model's deviation from the ideal contact, unless the contact has ended."""
    assert tracker.deviation is not None
    depth, rate = signals.position_desired, signals.velocity_desired
    if tracker.side is not None:
        depth = jnp.where(tracker.side > 0, depth, -constants.clearance - depth)
        rate = tracker.side * rate
    now = signals.age.astype(rate.dtype)
    deviation = update_deviation(
        tracker.deviation, probe.depth, probe.span, depth, rate, now, constants.control_period, ~has_ended
    )
    return tracker._replace(deviation=deviation)
