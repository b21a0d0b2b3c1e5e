"""Probe of a run beside its contact: a push on the hardware, and the reference trajectory.

A push that no model contains shows whether a compensator is transparent: whether events on the hardware reach
the numerical model. The motion in the ideal contact shows how far the model deviates from it. The time of the
push counts from the hardware's first touch, that of the trajectory from the numerical model's first touch.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Push(NamedTuple):
    """Force p(t) = size sin(pi (t - centre + width/2)/width) while the sine is positive, else 0."""

    size: Float[Array, "*batch"]  # against the penetration [N]
    centre: Float[Array, "*batch"]  # time since the hardware's first touch [s]
    width: Float[Array, "*batch"]  # [s]

    def force(self, time: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Return p [N] at a time [s] since the first touch."""
        since = time - self.centre + self.width / 2
        inside = (since > 0) & (since < self.width)
        phase = jnp.where(inside, since, 0) * (jnp.pi / self.width)
        return self.size * jnp.where(inside, jnp.sin(phase), 0)

    def lagged(
        self, time: Float[Array, "*batch"], time_constant: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """Return the push as read by a sensor with a first-order lag [s]: 1/(1 + s tau_s) applied to p.

        With w = pi/width and s the time since the push began, the closed form is size/(1 + (w tau)^2) (sin ws
        - w tau cos ws + w tau exp(-s/tau)) until the push ends, then exponential decay.
        """
        lags = time_constant > 0
        lag = jnp.where(lags, time_constant, 1)
        since = time - self.centre + self.width / 2
        begun = since > 0
        within = jnp.clip(jnp.where(begun, since, 0), 0, self.width)
        rate = jnp.pi / self.width
        late = rate * lag
        swing = jnp.sin(rate * within) - late * jnp.cos(rate * within) + late * jnp.exp(-within / lag)
        left = jnp.exp(-jnp.where(since > self.width, since - self.width, 0) / lag)
        reading = self.size / (1 + late**2) * jnp.where(begun, swing * left, 0)
        return jnp.where(lags, reading, self.force(time))


class Probe(NamedTuple):
    """Probe of each contact of a run."""

    push: Push  # push on the hardware, leaves (slots, *batch)
    # penetration of the ideal contact [m] at evenly spaced times from its first touch to `span`
    depth: Float[Array, "slots samples *batch"]
    span: Float[Array, "slots *batch"]  # duration of the comparison [s]


class FirstContact(NamedTuple):
    """First touch of the hardware in the current contact."""

    made: Bool[Array, "*batch"]  # whether there was one
    time: Float[Array, "*batch"]  # time of the touch, in periods of the run
    side: Float[Array, "*batch"]  # side of the surface, 1 or -1


class Deviation(NamedTuple):
    """Deviation of the numerical model from the ideal contact."""

    entered: Bool[Array, "*batch"]  # whether the numerical model has entered the contact
    time: Float[Array, "*batch"]  # time of the onset, in periods of the run
    squares: Float[Array, "*batch"]  # sum of the squared deviations of its penetration [m^2]
    count: Float[Array, "*batch"]  # number of these deviations


def initial_first_contact(like: Float[Array, "*batch"]) -> FirstContact:
    """Return the state before the first touch."""
    zeros = jnp.zeros_like(like)
    return FirstContact(jnp.zeros(like.shape, bool), zeros, zeros + 1)


def update_first_contact(
    first_contact: FirstContact, depth: Array, rate: Array, side: Array, now: Array, period: Array
) -> FirstContact:
    """Update the hardware's first touch with a sample.

    At `now` [periods] the hardware is `depth` [m] beyond the surface on `side` and moves inward at `rate`
    [m/s]. The time of the touch is extrapolated by uniform motion.
    """
    first = ~first_contact.made & (depth > 0)
    return FirstContact(
        first_contact.made | first,
        jnp.where(first, now - _periods_since_touch(depth, rate, period), first_contact.time),
        jnp.where(first, side, first_contact.side),
    )


def initial_deviation(like: Float[Array, "*batch"]) -> Deviation:
    """Return the state before the numerical model touches."""
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
    """Compare the numerical model with the reference trajectory while the contact `lasts`.

    At `now` [periods] the model has penetrated by `depth` [m] and moves inward at `rate` [m/s].
    """
    first = ~deviation.entered & (depth > 0)
    entered = deviation.entered | first
    begin = jnp.where(first, now - _periods_since_touch(depth, rate, period), deviation.time)
    since = jnp.where(entered, now - begin, 0) * period
    samples = len(reference)
    position = jnp.clip(since / span, 0, 1) * (samples - 1)
    before = jnp.clip(jnp.floor(position), 0, samples - 2)
    share = position - before
    index = before.astype(jnp.int32)[None]
    left = jnp.take_along_axis(reference, index, axis=0, mode="promise_in_bounds")[0]
    right = jnp.take_along_axis(reference, index + 1, axis=0, mode="promise_in_bounds")[0]
    off = depth - (left + share * (right - left))
    counts = entered & lasts & (since <= span)
    return Deviation(
        entered,
        begin,
        deviation.squares + jnp.where(counts, off**2, 0),
        deviation.count + jnp.where(counts, 1, 0).astype(off.dtype),
    )


def root_mean_square(deviation: Deviation) -> Float[Array, "*batch"]:
    """Return the root mean square of the penetration's deviation [m]; 0 if nothing was compared."""
    mean = deviation.squares / jnp.maximum(deviation.count, 1)
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1)), 0)


def _periods_since_touch(depth, rate, period):
    """Return the periods since a uniform motion reached the surface, at most one."""
    stride = rate * period
    inward = stride > 0
    return jnp.where(inward, jnp.clip(depth / jnp.where(inward, stride, 1), 0, 1), 0)
