"""The retrospective reference where the force delay is hardly known: a bank of delays, weighed as one goes.

`retrospective_reference` with `delay_bank` in the place of its one map. Hypotheses lie evenly within
`delay_spread` of `identification_delay`; with 0 it is the retrospective reference, but for readings of no
force while a contact closes, from which the bank learns as well. What was learnt of the delay, and of whether
there is any damping, is carried from contact to contact; maps are not. With d the mean of the hypotheses'
delays on the tick before, the depth as old as the force is X - d V, and the measured samples that the
reference is integrated over again with are moved alike.

Delays are told apart by how badly maps fit, which a prior that no contact fits would decide: it is wide. The
instant at which a surface is met says most of a delay where the surface's place is known to a few
micrometres: only what the mechanism file says of that is believed, and no more than 3 um.
"""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp

from jaxhil.compensators.base import Gain, rig_gain
from jaxhil.compensators.delay_bank import begin, learn, no_bank
from jaxhil.compensators.estimates import (
    DEAD_ZONE,
    EQUIVALENT_MASS,
    FORCE_NOISE,
    ROUGH_FORCE_DELAY,
    force_delay_spread,
    preload,
)
from jaxhil.compensators.history import reading_at, recall
from jaxhil.compensators.hypotheses import suppose
from jaxhil.compensators.lagged_onset import WINDOW, Window
from jaxhil.compensators.reintegration import beyond
from jaxhil.compensators.retrospective_reference import RetrospectiveReference

MOST = 0.004  # s: beyond it hypotheses are too far apart, and too far off for the first order in d
LEAST_FLOOR = 0.005  # 1/s
LEAST_PLANE_SPREAD = 3e-6  # m: a rig's surface is not known better, and by 5 um tells a delay by 1 ms
WIDE = {"prior_stiffness": 200.0, "prior_stiffness_spread": 250.0, "prior_slope_spread": 250.0}  # 1/s^2


def _own(gain: Gain) -> Gain:
    """One of the retrospective reference's gains, as it is where the delay is hardly known."""
    if gain.name in WIDE:
        return gain._replace(nominal=lambda m: WIDE[gain.name])
    if gain.name == "prior_preload_spread":
        return gain._replace(nominal=preload)
    if gain.name == "plane_spread":
        told = gain.nominal
        return gain._replace(
            lower=lambda m: LEAST_PLANE_SPREAD, nominal=lambda m: max(told(m), LEAST_PLANE_SPREAD)
        )
    # Next to no noise, a delay that is a little wrong is all that a hypothesis sees.
    return gain._replace(lower=lambda m: LEAST_FLOOR) if gain.name == "force_noise_floor" else gain


class RetrospectiveDelayBank(RetrospectiveReference):
    """Bank of delays, reference and repayment; see the module's text."""

    name: ClassVar[str] = "retrospective_delay_bank"
    estimates_delay: ClassVar[bool] = True
    misfit: ClassVar[float] = 0.01
    knows: ClassVar[tuple[str, ...]] = (EQUIVALENT_MASS, ROUGH_FORCE_DELAY, FORCE_NOISE, DEAD_ZONE)
    settings: ClassVar[Mapping[str, Mapping[str, float]]] = {
        name: {**gains, **WIDE} for name, gains in RetrospectiveReference.settings.items()
    }
    gains: ClassVar[tuple[Gain, ...]] = (
        *(_own(gain) for gain in RetrospectiveReference.gains),
        rig_gain(
            "delay_spread",
            lower=lambda m: 0.0,
            upper=lambda m: MOST,
            nominal=lambda m: min(force_delay_spread(m), MOST),
            tuned=lambda m: False,
        ),
        rig_gain(
            "sensor_lag",
            lower=lambda m: 0.0,
            upper=lambda m: 2 * m.rig.force_sensor.time_constant + 0.02,
            nominal=lambda m: m.rig.force_sensor.time_constant,
            tuned=lambda m: False,
        ),
    )

    def unlearnt(self, prior):
        return no_bank(prior)

    def moved(self, learnt):
        return learnt.shift * learnt.pace, learnt.deeper

    def begin(self, prepared, learnt, meeting, history, variance):
        gains, period = prepared.gains, prepared.constants.control_period
        window = _newest(prepared, meeting, history, variance)
        supposed = suppose(gains["delay_spread"], gains["sensor_lag"])
        known = supposed, gains["plane_spread"], gains["prior_damping_spread"] ** 2
        return begin(learnt, prepared.prior, meeting, window, period, *known)

    def learn(self, prepared, learnt, reading, deepest):
        gains, period = prepared.gains, prepared.constants.control_period
        supposed = suppose(gains["delay_spread"], gains["sensor_lag"])
        return learn(learnt, reading, period, supposed, gains["prior_damping_spread"] ** 2)

    def force_delay(self, gains, state):
        return gains["identification_delay"] + state.learnt.shift


def _newest(prepared, meeting, history, variance) -> Window:
    """The newest readings, where a surface is met; the noise of the force [N^2]."""
    scales, found, clearance = meeting.scales, meeting.found, prepared.constants.clearance
    speed, pace, weight = (jnp.where(found, each, 1) for each in (scales.speed, scales.pace, scales.weight))
    depths, forces, kept = [], [], []
    for age in range(WINDOW - 1, -1, -1):
        index = jnp.maximum(history.age - age, 0)
        force, shown = reading_at(history, index)
        position = recall(history, index).position
        depths.append((beyond(scales.side, clearance, position) - meeting.place) / (speed / pace))
        forces.append(scales.side * (force - scales.bias) / weight)
        kept.append(shown & (history.age >= age))
    floor = prepared.gains["force_noise_floor"] ** 2
    return Window(jnp.stack(depths), jnp.stack(forces), jnp.stack(kept), floor + variance / weight**2)
