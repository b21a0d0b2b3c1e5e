"""What a run is probed with, beside its contact: a push on the hardware, and the motion it should have had.

A push that no model knows of shows whether a law is transparent: whether what happens to the hardware reaches
the numerical model. The motion of the same contact in space shows how far the model is led off it. Both count
from the first touch, of the hardware the one, of the numerical model the other.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Push(NamedTuple):
    """A force p(t) = size sin(pi (t - centre + width/2)/width) while the sine is positive, else 0."""

    size: Float[Array, "*batch"]  # against the penetration [N]
    centre: Float[Array, "*batch"]  # in time since the hardware's first touch [s]
    width: Float[Array, "*batch"]  # [s]

    def force(self, time: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """p [N] at a time [s] since the first touch."""
        since = time - self.centre + self.width / 2
        inside = (since > 0) & (since < self.width)
        phase = jnp.where(inside, since, 0) * (jnp.pi / self.width)
        return self.size * jnp.where(inside, jnp.sin(phase), 0)

    def lagged(
        self, time: Float[Array, "*batch"], time_constant: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """What a sensor with a first-order lag [s] reads of it: 1/(1 + s tau_s) applied to p, in closed form.

        With w = pi/width and s since the push began: size/(1 + (w tau)^2) (sin ws - w tau cos ws
        + w tau exp(-s/tau)) until it ends, then exponential decay.
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
    """What each contact of a run is probed with."""

    push: Push  # on the hardware, leaves (slots, *batch)
    # penetration of the same contact in space [m] at times evenly spaced from its first touch to `span`
    depth: Float[Array, "slots samples *batch"]
    span: Float[Array, "slots *batch"]  # how long that contact is followed [s]


class FirstContact(NamedTuple):
    """The hardware's first touch in the contact under way."""

    made: Bool[Array, "*batch"]  # whether there was one
    time: Float[Array, "*batch"]  # of it, in periods of the run
    side: Float[Array, "*batch"]  # of the surface, 1 or -1


class Deviation(NamedTuple):
    """The numerical model beside the contact in space."""

    entered: Bool[Array, "*batch"]  # whether the numerical model has entered the contact
    time: Float[Array, "*batch"]  # of that, in periods of the run
    squares: Float[Array, "*batch"]  # sum of the squares of what its depth is off by [m^2]
    count: Float[Array, "*batch"]  # how many they are


def before_contact(like: Float[Array, "*batch"]) -> FirstContact:
    """Before the first touch."""
    zeros = jnp.zeros_like(like)
    return FirstContact(jnp.zeros(like.shape, bool), zeros, zeros + 1)


def follow_hardware(
    first_contact: FirstContact, depth: Array, rate: Array, side: Array, now: Array, period: Array
) -> FirstContact:
    """Follow the hardware to a sample: at `now` [periods] it is `depth` [m] beyond the surface on `side`,
    going deeper at `rate` [m/s]. The first touch lies where uniform motion met the surface."""
    first = ~first_contact.made & (depth > 0)
    return FirstContact(
        first_contact.made | first,
        jnp.where(first, now - _since(depth, rate, period), first_contact.time),
        jnp.where(first, side, first_contact.side),
    )


def no_deviation(like: Float[Array, "*batch"]) -> Deviation:
    """Before the numerical model has entered."""
    zeros = jnp.zeros_like(like)
    return Deviation(jnp.zeros(like.shape, bool), zeros, zeros, zeros)


def follow_model(
    deviation: Deviation,
    reference: Float[Array, "samples *batch"],
    span: Array,
    depth: Array,
    rate: Array,
    now: Array,
    period: Array,
    lasts: Array,
) -> Deviation:
    """Compare the numerical model with the reference, at `now` [periods], as long as the contact `lasts`."""
    first = ~deviation.entered & (depth > 0)
    entered = deviation.entered | first
    begin = jnp.where(first, now - _since(depth, rate, period), deviation.time)
    since = jnp.where(entered, now - begin, 0) * period
    samples = len(reference)
    place = jnp.clip(since / span, 0, 1) * (samples - 1)
    before = jnp.clip(jnp.floor(place), 0, samples - 2)
    share = place - before
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
    """Of x_d's depth off the reference's [m]; 0 where nothing was compared."""
    mean = deviation.squares / jnp.maximum(deviation.count, 1)
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1)), 0)


def _since(depth, rate, period):
    """Periods since a uniform motion met the surface, one at most."""
    stride = rate * period
    inward = stride > 0
    return jnp.where(inward, jnp.clip(depth / jnp.where(inward, stride, 1), 0, 1), 0)
