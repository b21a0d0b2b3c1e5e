"""Phase lead with an observer of the force that the force sensor's dead zone removes.

    F_c = lead(F + Q(s) u(k_n d)),     Q(s) = 1/(1 + s/(2 pi f))

F is the measured force, dz the half-width of the dead zone, and k_n the nominal stiffness. d is the measured
penetration, delayed like F. u(F) is the force that the dead zone removes. A continuous dead zone removes
clip(F, -dz, dz). A cut dead zone removes F if |F| <= dz, else 0.

Li et al. 2026 combine a hybrid Smith predictor with a disturbance observer (|Q| near 1 below 15 Hz) for a cut
dead zone. A general disturbance observer adds Q (F_n - F), where F_n is the force of a nominal model. This
observer uses the known effect of a dead zone; the nominal model k_n d replaces F in u. If k_n is wrong, the
observer has an error only for |F| < dz. With a cut dead zone, there is also an error between |F| = dz and
|k_n d| = dz.

Q is discretised by Tustin's rule. |Q| >= 0.9 up to 15 Hz needs f >= 15 Hz/sqrt(1/0.81 - 1) = 31 Hz. Q lags by
1/(2 pi f). To compensate for this lag, the delay of d (`identification_delay`) is shorter than the force
delay tau_f by the same time; this requires f >= 1/(2 pi tau_f).

A continuous dead zone moves the surface of a linear contact by dz/k. The restitution does not change, but the
hardware moves deeper into the mechanism, and the contact force is larger by dz. A cut dead zone removes
different amounts of mechanical work during compression and expansion. The restitution therefore changes too.
The observer corrects both kinds of dead zone.
"""

import math
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.contact.laws import deflection
from jaxhil.laws.shared.delay_line import (
    DelayInPeriods,
    DelayLine,
    empty_delay_line,
    read_delayed,
    split_delay,
)
from jaxhil.laws.shared.lead_filter import (
    LEAD_FILTER,
    PHASE_LEAD,
    LeadFilter,
    LeadState,
    apply_lead_filter,
    build_lead_filter,
    lead_amplification,
)
from jaxhil.laws.shared.nominal_values import (
    DEAD_ZONE,
    FORCE_DELAY,
    STIFFNESS,
    force_delay,
    peak_force,
    typical_stiffness,
)
from jaxhil.laws.simulation_base import Compensator, Gain, Gains, clear_lanes, rig_gain
from jaxhil.mechanism.structs import Mechanism

PASSBAND = 15.0, 0.9  # [Hz], [1]; up to this frequency, |Q| is at least this gain


def _max_bandwidth(mechanism: Mechanism) -> float:
    """Return the largest bandwidth [Hz] of the observer's filter Q, at which its discrete pole is 0.

    Above this bandwidth, Q's output would alternate in sign.
    """
    return 1 / (math.pi * mechanism.rig.control_period)


def _nominal_bandwidth(mechanism: Mechanism) -> float:
    frequency, gain = PASSBAND
    widest, delay = _max_bandwidth(mechanism), force_delay(mechanism)
    without_lag = 1 / (2 * math.pi * delay) if delay > 0 else widest
    return min(max(frequency / math.sqrt(1 / gain**2 - 1), without_lag), widest)


def _nominal_alignment(mechanism: Mechanism) -> float:
    return max(force_delay(mechanism) - 1 / (2 * math.pi * _nominal_bandwidth(mechanism)), 0.0)


def _is_continuous(mechanism: Mechanism) -> bool:
    return mechanism.rig.force_sensor.dead_zone_kind == "continuous"


class DeadZoneObserverState(NamedTuple):
    """State of the dead-zone observer after a tick."""

    lead: LeadState
    withheld: Float[Array, "*batch"]  # input of Q on the last tick [N]
    observed: Float[Array, "*batch"]  # output of Q on the last tick [N]
    line: DelayLine  # delay line of the measured positions


class PreparedObserver(NamedTuple):
    """Gains and filter coefficients of the dead-zone observer, computed once per run."""

    gains: Gains
    clearance: Float[Array, "*batch"]  # clearance of a two-sided contact [m]
    lead: LeadFilter
    # coefficients [1] of Q, y(n) = pole y(n-1) + share (u(n) + u(n-1))
    pole: Float[Array, "*batch"]
    share: Float[Array, "*batch"]
    delay: DelayInPeriods  # delay that aligns the measured positions with the force


class DeadZoneObserver(Compensator):
    """Compensator F_c = lead(F + Q u(k_n d)): phase lead on the measured force and an estimated force.

    The estimate is the force that the sensor's dead zone removes. The module's docstring defines the symbols.
    """

    name: ClassVar[str] = "dead_zone_observer"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY, STIFFNESS, DEAD_ZONE)
    waits_for_contact: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = (
        PHASE_LEAD,
        LEAD_FILTER,
        rig_gain(
            "observer_stiffness", lambda m: 0.0, lambda m: 5 * typical_stiffness(m), typical_stiffness
        ),
        rig_gain(
            "observer_bandwidth", lambda m: 0.1 * _nominal_bandwidth(m), _max_bandwidth, _nominal_bandwidth,
            logarithmic=True,
        ),
        rig_gain(
            "observer_limit", lambda m: 0.0,
            lambda m: 2 * m.rig.force_sensor.dead_zone + peak_force(m),
            lambda m: m.rig.force_sensor.dead_zone, neutral=0.0, tuned=_is_continuous,
        ),
        # Force that is added if k_n d is beyond the limit, divided by the limit.
        rig_gain(
            "observer_saturation", lambda m: 0.0, lambda m: 1.0, lambda m: float(_is_continuous(m)),
            tuned=lambda m: False,
        ),
        rig_gain(
            "identification_delay", lambda m: 0.0, lambda m: 2 * force_delay(m) + 0.02,
            _nominal_alignment,
        ),
    )  # fmt: skip

    def prepare(self, gains, constants):
        period = constants.control_period
        corner = (2 * math.pi) * gains["observer_bandwidth"] * period
        scale = 1 / (2 + corner)
        return PreparedObserver(
            gains,
            constants.clearance,
            build_lead_filter(gains, constants),
            (2 - corner) * scale,
            corner * scale,
            split_delay(gains["identification_delay"], period),
        )

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        return DeadZoneObserverState(LeadState(zeros, zeros), zeros, zeros, empty_delay_line(ring, zeros))

    def restart(self, gains, state, begins, fresh):
        return state._replace(
            lead=clear_lanes(state.lead, begins),
            withheld=jnp.where(begins, 0, state.withheld),
            observed=jnp.where(begins, 0, state.observed),
        )

    def step(self, prepared, state, signals, tick):
        gains = prepared.gains
        aligned, line = read_delayed(prepared.delay, state.line, signals, tick)
        force = gains["observer_stiffness"] * deflection(aligned, prepared.clearance)
        most = gains["observer_limit"]
        beyond = gains["observer_saturation"] * most
        withheld = jnp.where(force > most, beyond, jnp.where(force < -most, -beyond, force))
        observed = prepared.pole * state.observed + prepared.share * (withheld + state.withheld)
        command, lead_state = apply_lead_filter(prepared.lead, state.lead, signals.force_measured + observed)
        return command, DeadZoneObserverState(lead_state, withheld, observed, line)

    def noise_amplification(self, gains, constants):
        # The observed force does not depend on the force readings.
        return lead_amplification(build_lead_filter(gains, constants))


COMPENSATOR = DeadZoneObserver()
