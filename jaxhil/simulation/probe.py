"""Probe for tests of a compensator: an additional push on the hardware, and a reference trajectory.

No model contains the push. The push shows whether a compensator is transparent, that is, whether events on
the hardware reach the numerical model. The reference trajectory is the motion in the ideal contact; the
numerical model should follow it.

The time of the push counts from the hardware's first touch. The time of the reference trajectory counts from
the numerical model's first touch.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.lanes import as_complex, safe_sqrt
from jaxhil.mechanism.sensor_filter import FilterModes


class Push(NamedTuple):
    """Test push on the hardware: a force with the shape of a half-sine.

    The force is size sin(pi s/width) for 0 < s < width, else 0. Here s = t - centre + width/2 is the time
    since the push began, and t is the time since the hardware's first touch.
    """

    size: Float[Array, "*batch"]  # largest force [N]; a positive force acts against the penetration
    centre: Float[Array, "*batch"]  # time of the largest force since the hardware's first touch [s]
    width: Float[Array, "*batch"]  # duration [s]

    def force(self, time: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Return the force of the push [N] at a time [s] since the hardware's first touch."""
        since = time - self.centre + self.width / 2
        inside = (since > 0) & (since < self.width)
        phase = jnp.where(inside, since, 0) * (jnp.pi / self.width)
        return self.size * jnp.where(inside, jnp.sin(phase), 0)

    def lagged(
        self, time: Float[Array, "*batch"], time_constant: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """Return the push [N] as a sensor with a first-order lag reads it.

        Until the push ends, the reading is size/(1 + a^2) (sin(w s) - a cos(w s) + a exp(-s/tau)). Here
        w = pi/width, tau is the time constant, a = w tau, and s is the time since the push began. Afterwards,
        the reading decays exponentially.

        Args:
            time: Time since the hardware's first touch [s].
            time_constant: Time constant of the lag [s]; 0 for a sensor without lag.
        """
        lags = time_constant > 0
        lag = jnp.where(lags, time_constant, 1)
        since = time - self.centre + self.width / 2
        begun = since > 0
        within = jnp.clip(jnp.where(begun, since, 0), 0, self.width)
        rate = jnp.pi / self.width
        late = rate * lag
        swing = jnp.sin(rate * within) - late * jnp.cos(rate * within) + late * jnp.exp(-within / lag)
        decay = jnp.exp(-jnp.where(since > self.width, since - self.width, 0) / lag)
        reading = self.size / (1 + late**2) * jnp.where(begun, swing * decay, 0)
        return jnp.where(lags, reading, self.force(time))

    def filtered(
        self, time: Float[Array, "*batch"], modes: FilterModes, cutoff: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """Return the push [N] as a sensor with a low-pass filter reads it.

        Every mode of the filter responds like a first-order lag (`lagged`) with a complex time constant.

        Args:
            time: Time since the hardware's first touch [s].
            modes: Modes of the filter for the cutoff 1 rad/s.
            cutoff: Cutoff frequency of the filter [rad/s].
        """
        since = time - self.centre + self.width / 2
        begun = since > 0
        within = as_complex(jnp.clip(jnp.where(begun, since, 0), 0, self.width))
        after = as_complex(jnp.where(since > self.width, since - self.width, 0))
        rate, total = as_complex(jnp.pi / self.width), jnp.zeros_like(time)
        for weight, mode in zip(modes.weights, modes.rates, strict=True):
            decay = mode * as_complex(cutoff)
            late = rate / decay
            swing = jnp.sin(rate * within) - late * jnp.cos(rate * within) + late * jnp.exp(-within * decay)
            total = total + jnp.real(weight / (1 + late**2) * swing * jnp.exp(-after * decay))
        return self.size * jnp.where(begun, total, 0)


class Probe(NamedTuple):
    """Test push on the hardware, and ideal contact as the numerical model's reference, for each contact."""

    push: Push  # push on the hardware, (contacts, *batch)
    # penetration in the ideal contact [m] at evenly spaced times, from 0 to `span` after the first touch
    depth: Float[Array, "slots samples *batch"]
    span: Float[Array, "slots *batch"]  # duration of the reference trajectory [s]


class FirstContact(NamedTuple):
    """First touch of the hardware in the current contact."""

    made: Bool[Array, "*batch"]  # whether the hardware has touched a surface
    time: Float[Array, "*batch"]  # time of the first touch since the start of the run [control periods]
    side: Float[Array, "*batch"]  # side of the surface, 1 or -1


class Deviation(NamedTuple):
    """Sum of the squared deviations of the numerical model's penetration from the reference trajectory."""

    entered: Bool[Array, "*batch"]  # whether the numerical model has touched the surface
    time: Float[Array, "*batch"]  # time of the model's first touch since the run's start [control periods]
    squares: Float[Array, "*batch"]  # sum of the squared deviations at all ticks [m^2]
    count: Float[Array, "*batch"]  # number of ticks in the sum of squared deviations


def initial_first_contact(like: Float[Array, "*batch"]) -> FirstContact:
    """Return the record of hardware that has not touched a surface yet, with the batch shape of `like`."""
    zeros = jnp.zeros_like(like)
    return FirstContact(jnp.zeros(like.shape, bool), zeros, zeros + 1)


def update_first_contact(
    first_contact: FirstContact, depth: Array, rate: Array, side: Array, now: Array, period: Array
) -> FirstContact:
    """Return the record of the first touch, updated with a sample of the hardware's motion.

    The time of the touch is extrapolated from the sample, assuming uniform motion.

    Args:
        first_contact: Record up to the previous sample.
        depth: Penetration of the hardware [m].
        rate: Penetration rate of the hardware [m/s].
        side: Side of the surface, 1 or -1.
        now: Time since the start of the run [control periods].
        period: Control period [s].
    """
    first = ~first_contact.made & (depth > 0)
    return FirstContact(
        first_contact.made | first,
        jnp.where(first, now - _periods_since_touch(depth, rate, period), first_contact.time),
        jnp.where(first, side, first_contact.side),
    )


def initial_deviation(like: Float[Array, "*batch"]) -> Deviation:
    """Return the probe's deviation before the first touch: 0, with the batch shape of `like`."""
    zeros = jnp.zeros_like(like)
    return Deviation(jnp.zeros(like.shape, bool), zeros, zeros, zeros)


def update_deviation(
    deviation: Deviation,
    reference: Float[Array, "samples *batch"],
    span: Array,
    depth: Array,
    rate: Array,
    now: Array,
    period: Array,
    lasts: Array,
) -> Deviation:
    """Add the numerical model's deviation at the current tick to the sums of `deviation`.

    Args:
        deviation: Deviation up to the previous tick.
        reference: Penetration of the reference trajectory [m], at evenly spaced times.
        span: Duration of the reference trajectory [s].
        depth: Penetration of the numerical model [m].
        rate: Penetration rate of the numerical model [m/s].
        now: Time since the start of the run [control periods].
        period: Control period [s].
        lasts: Whether the contact continues; otherwise nothing is added.
    """
    first = ~deviation.entered & (depth > 0)
    entered = deviation.entered | first
    begin = jnp.where(first, now - _periods_since_touch(depth, rate, period), deviation.time)
    since = jnp.where(entered, now - begin, 0) * period
    samples = len(reference)
    position = jnp.clip(since / span, 0, 1) * (samples - 1)
    before = jnp.clip(jnp.floor(position), 0, samples - 2)
    fraction = position - before
    index = before.astype(jnp.int32)[None]
    before_value = jnp.take_along_axis(reference, index, axis=0, mode="promise_in_bounds")[0]
    after_value = jnp.take_along_axis(reference, index + 1, axis=0, mode="promise_in_bounds")[0]
    difference = depth - (before_value + fraction * (after_value - before_value))
    is_counted = entered & lasts & (since <= span)
    return Deviation(
        entered,
        begin,
        deviation.squares + jnp.where(is_counted, difference**2, 0),
        deviation.count + jnp.where(is_counted, 1, 0).astype(difference.dtype),
    )


def root_mean_square(deviation: Deviation) -> Float[Array, "*batch"]:
    """Return the root mean square of the deviation [m]; 0 before the numerical model's first touch."""
    mean = deviation.squares / jnp.maximum(deviation.count, 1)
    return safe_sqrt(mean)


def _periods_since_touch(depth, rate, period):
    """Return the time since a surface was touched [control periods], 0 to 1, assuming uniform motion."""
    stride = rate * period
    inward = stride > 0
    return jnp.where(inward, jnp.clip(depth / jnp.where(inward, stride, 1), 0, 1), 0)
