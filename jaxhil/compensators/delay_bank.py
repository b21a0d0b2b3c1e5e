"""Hypotheses of the force delay and of a lag side by side, each with a map of its own, weighed by what they
explain.

Hypothesis h takes the force to be d_h [s] older than assumed: it belongs to the depth X - d_h V - p_h, to
first order in d_h. The surface was met at X_0; by this hypothesis it lies at p_h = g (X_0 - d_h v_0) beyond
where it was told, g = spread^2/(spread^2 + found^2) by how uncertain either is, or 1 where they disagree. As
many others take the sensor to lag by l_h [s]: what the force is linear in is smoothed alike, and the surface
was met where `lagged_onset` has it. To first order a lag is a delay: these count as l_h older. Each delay is
there twice, by slopes that wander and by slopes that hardly do: how much they do is for the contacts to
decide. Each hypothesis identifies a `force_depth_map` of its own and says beforehand what it expects to read,
f_h with a variance s_h (0 with the noise's own variance r out of contact, and where what it expects while the
contact opens is not positive). Its weight is the product of the likelihood of all readings y of this contact
and of those before, in each (r/s_h)^(1/4) exp(-(y - f_h)^2/(4 s_h)), of how well its damping goes with what
is known of contacts (`plausibility`), and of how likely its surface is there, of delays by `entry`: see
notebooks/guide/retrospective_reference.md section 7. The exponentials are (1 + u/n)^-n: algebraic, the same
on every machine. What counts is the mean over all hypotheses, of their maps, delays and surfaces. Their maps
bend at the same places, wherever they have the surface: which fits best is not to be decided by what a
contact that bends between two knots leaves.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.compensators.entry import (
    DENSITY_SQUARINGS,
    NOT_THERE,
    UNLIKELY,
    USUAL,
    Entry,
    agree,
    cumulative,
    enter,
    no_entry,
)
from jaxhil.compensators.force_depth_map import (
    DAMPING,
    FRICTION,
    KNOTS,
    PLACES,
    PRELOAD,
    SEGMENTS,
    SURFACE,
    Curve,
    Map,
    Reading,
    correct,
    features,
    positive_mean,
    predict,
)
from jaxhil.compensators.hypotheses import (
    DELAYED,
    DELAYS,
    FIRST_LAG,
    HYPOTHESES,
    LAGS,
    Supposed,
)
from jaxhil.compensators.lagged_onset import Window, lagged_onsets
from jaxhil.compensators.meeting import Meeting
from jaxhil.compensators.onset import SQUARINGS, exponential

STEADY = 0.125  # of the spread by which slopes wander, where they hardly do
ELASTIC = 0.35  # probability that a contact has no damping
BROADENING = 2.0  # of the variance of the damping
# The least share of a likelihood, within a contact and of those before: what they rule out can come back.
LEAST, LEAST_CARRIED = 1e-200, 1e-12
NOTHING = 1e-300  # a smaller product is none: some machines keep such numbers, some do not
LEAST_SHIFT = 1e-12  # s: where nothing tells delays apart, rounding does not either
FARTHEST, WHOLE = 0.004, 0.015  # s by which knots are moved, from what depth [s] on; before it less
BEYOND_NOISE = 9.0  # times its variance: a force that is more than noise
EARLIER = 30  # ticks before it was met, whose readings count


class Bank(NamedTuple):
    """What is known of each hypothesis, and of the delay."""

    maps: Map  # of each hypothesis
    deepest: Float[Array, "hypotheses *batch"]  # point of this contact [s]
    likelihood: Float[Array, "hypotheses *batch"]  # of this contact's readings
    carried: Float[Array, "hypotheses *batch"]  # likelihood of the readings of the contacts before, once met
    precision: Float[Array, "hypotheses *batch"]  # sum of the damping's 1/s^2 over the contacts before [s^2]
    weighted: Float[Array, "hypotheses *batch"]  # sum of B/s^2 over them [s]
    met: Float[Array, "*batch"]  # how many they are
    learning: Float[Array, "*batch"]  # whether (1) this contact is to be added to them
    below: Float[Array, "hypotheses *batch"]  # by how much deeper each has the surface than it was met [s]
    pace: Float[Array, "*batch"]  # seconds on the contact's scale of time in one
    shift: Float[Array, "*batch"]  # mean of d_h [s]
    deeper: Float[Array, "*batch"]  # mean of `below` [s]
    farther: Float[Array, "hypotheses *batch"]  # by how much farther in each has its knots than usual [s]
    likely: Float[Array, "hypotheses *batch"]  # how likely the surface is there
    held: Float[Array, "parameters lags *batch"]  # what the force is linear in as a lagging sensor shows it
    before: Float[Array, "parameters lags *batch"]  # and as it was at the reading before
    pushed: Float[Array, "lags *batch"]  # whether (1) the contact then pushed
    entry: Entry  # of this contact, by delays
    within: Float[Array, "delays *batch"]  # how deep the surface is, by the maps of delays [s]


def no_bank(prior: Map) -> Bank:
    """Before the first contact."""
    zero = jnp.zeros_like(prior.mean[0])
    each = jnp.stack([zero] * HYPOTHESES)
    held = jnp.stack([each[:LAGS]] * len(prior.mean))
    return Bank(
        _priors(prior), each, each + 1, each + 1, each, each, zero, zero, each, zero + 1, zero, zero,
        each, each + 1, held, held, held[0], no_entry(zero, FIRST_LAG), each[:FIRST_LAG],
    )  # fmt: skip


def begin(
    old: Bank,
    prior: Map,
    meeting: Meeting,
    window: Window,
    period: Array,
    supposed: Supposed,
    plane_spread: Array,
    damping: Array,
) -> tuple[Bank, Int[Array, "*batch"]]:
    """Where a contact begins: the one before is added to what is carried, and the maps are the prior; from
    how many ticks before it was met on to learn from the readings.

    `window`: the newest readings; `period` [s] is that of control, `plane_spread` [m] how uncertain it is
    where the surface was told, `damping` [1/s^2] the prior variance s_0^2 of the damping.
    """
    begins = meeting.found
    ends = begins & (old.learning > 0)
    per_second = old.pace * old.pace
    mean = old.maps.mean[DAMPING] * old.pace[None]
    variance = old.maps.covariance[DAMPING, DAMPING] * per_second[None]
    precision = 1 / jnp.where(variance > 0, variance, 1)
    speed, pace = (jnp.where(begins, each, 1) for each in (meeting.scales.speed, meeting.scales.pace))
    tick = period * pace
    true = prior.covariance[PRELOAD, PRELOAD]
    lagged = lagged_onsets(supposed.lags * pace[None], window, tick)
    placed = _place(meeting, window, supposed.offsets, speed, pace, tick, plane_spread, true, lagged)
    first = jnp.max((-placed.below - supposed.offsets * pace[None])[FIRST_LAG:], axis=0)
    earlier = jnp.minimum(jnp.ceil(jnp.where(first > SURFACE, first, 0) / tick), EARLIER).astype(jnp.int32)
    before, carried = (
        jnp.where(old.met[None] > 0, old.carried, each) for each in (supposed.first, supposed.either)
    )
    evidence = old.likelihood * jnp.where(_column(DELAYED, old.likely) > 0, old.likely, 1)
    fresh = _priors(prior)
    fresh = fresh._replace(covariance=fresh.covariance.at[PRELOAD, PRELOAD].add(placed.preload))
    now = old._replace(
        maps=Map(
            jnp.where(begins[None, None], fresh.mean, old.maps.mean),
            jnp.where(begins[None, None, None], fresh.covariance, old.maps.covariance),
        ),
        deepest=jnp.where(begins[None], 0, old.deepest),
        likelihood=jnp.where(begins[None], 1, old.likelihood),
        carried=jnp.where(ends[None], _shares(_weighed(carried, evidence), LEAST_CARRIED), before),
        precision=old.precision + jnp.where(ends[None], precision, 0),
        weighted=old.weighted + jnp.where(ends[None], precision * mean, 0),
        met=old.met + jnp.where(ends, 1, 0),
        learning=jnp.where(begins, 0, old.learning),
        below=jnp.where(begins[None], placed.below, old.below),
        farther=jnp.where(begins[None], placed.farther, old.farther),
        likely=jnp.where(begins[None], placed.likely, old.likely),
        pace=jnp.where(begins, pace, old.pace),
        held=jnp.where(begins[None, None], 0, old.held),
        before=jnp.where(begins[None, None], 0, old.before),
        pushed=jnp.where(begins[None], 0, old.pushed),
        entry=Entry(*(jnp.where(begins, *both) for both in zip(placed.entry, old.entry, strict=True))),
    )
    now = _entered(now)
    means = _means(now, weigh(now, damping), supposed)
    shift, deeper = (
        jnp.where(begins, a, b) for a, b in ((means.shift, old.shift), (means.deeper, old.deeper))
    )
    return now._replace(shift=shift, deeper=deeper), jnp.where(begins, earlier, 0)


def learn(
    old: Bank, reading: Reading, period: Array, supposed: Supposed, damping: Array
) -> tuple[Bank, Curve]:
    """The bank with one reading more, and the mean of its maps.

    `period` [s] is that of control, `damping` [1/s^2] the prior variance s_0^2 of the damping.
    """
    rate = reading.rate[None] + jnp.zeros_like(old.below)
    depth = reading.depth[None] - supposed.offsets * old.pace[None] * rate - old.below
    counts, hidden, zone = reading.counts[None], reading.hidden[None], reading.zone[None]
    deepest = jnp.where(counts & (depth > old.deepest), depth, old.deepest)
    noise = (reading.variance + jnp.where(reading.hidden, reading.zone**2 / 12, 0))[None]
    delayed = _column(DELAYED, depth) > 0
    # While a contact closes its force is not negative. Opening, nothing may be left of it before depth 0.
    closes = rate > 0
    own = depth - jnp.concatenate([old.within, jnp.zeros_like(depth[FIRST_LAG:])])
    inside = ~delayed | (jnp.where(closes, (reading.depth - old.entry.met)[None], own) > SURFACE)
    knots = knots_of(old)
    phi = features(depth, rate, deepest, knots)
    # Of a delay, the surface may lie before where its map has it.
    phi = phi.at[0, :FIRST_LAG].set(jnp.minimum(depth, knots[1])[:FIRST_LAG])
    held, pushes = _smooth(
        old, supposed.lags, depth[FIRST_LAG:], rate[FIRST_LAG:], phi[:, FIRST_LAG:], period
    )
    before, phi = phi[:, FIRST_LAG:], jnp.concatenate([phi[:, :FIRST_LAG], held], axis=1)
    predicted = predict(old.maps, phi, noise)
    # Hidden, a force is known to be small: half of the zone, where the map expects more than all of it.
    tight = hidden & (predicted.force <= zone)
    force = jnp.where(reading.hidden, 0.5 * reading.zone, reading.force)[None]
    force = force + jnp.zeros_like(depth)
    tells = (predicted.force > 0) | (force**2 > BEYOND_NOISE * noise)
    pushed = jnp.concatenate([jnp.ones_like(depth[:FIRST_LAG], dtype=bool), pushes])
    used = counts & inside & pushed & ~tight & (closes | tells)
    maps = correct(old.maps, predicted, force, used)

    nothing = ~inside | tight | (~closes & (predicted.force <= 0))
    wide = jnp.where(nothing, noise, predicted.variance)
    wide = jnp.where(wide > 0, wide, 1)
    read = jnp.where(reading.hidden, 0, reading.force)[None]
    missed = jnp.where(nothing, read, force - predicted.force)
    surprise = 0.25 * missed**2 / wide
    surprise = surprise - jnp.min(surprise, axis=0, keepdims=True)
    sharpness = jnp.sqrt(jnp.sqrt(jnp.where(wide > noise, noise / wide, 1)))
    likelihood = _shares(old.likelihood * sharpness * exponential(surprise, SQUARINGS), LEAST)
    now = old._replace(
        maps=maps,
        deepest=deepest,
        likelihood=jnp.where(counts, likelihood, old.likelihood),
        learning=jnp.where(reading.counts, 1, old.learning),
        held=jnp.where(counts[None], held, old.held),
        before=jnp.where(counts[None], before, old.before),
        pushed=jnp.where(counts, pushes.astype(old.pushed.dtype), old.pushed),
    )
    now = _entered(now)
    weights = weigh(now, damping)
    return _means(now, weights, supposed), average(maps, weights, knots)


def _entered(bank: Bank) -> Bank:
    """With what the maps of delays say of the entry."""
    maps = bank.maps
    entered = agree(bank.entry, Map(maps.mean[:, :FIRST_LAG], maps.covariance[:, :, :FIRST_LAG]))
    likely = jnp.concatenate([entered.likely, bank.likely[FIRST_LAG:]])
    return bank._replace(likely=likely, within=entered.place)


def _smooth(
    old: Bank, lag: Array, depth: Array, rate: Array, now: Array, period: Array
) -> tuple[Array, Array]:
    """What the force is linear in as sensors that lag show it: its mean over the tick, from the entry on
    where that is within it, as long as the contact pushes; whether it pushes."""
    closes = rate > 0
    raw = jnp.sum(now * old.maps.mean[:, FIRST_LAG:], axis=0)
    pushes = (depth > SURFACE) & (closes | (raw > 0))
    was = old.pushed > 0
    enters = pushes & ~was
    tick = (period * old.pace)[None]
    since = jnp.where(closes, depth / jnp.where(closes, rate, 1), 0)
    since = jnp.where(enters & (since < tick), since, tick)
    kept = exponential(period[None] / lag, SQUARINGS)
    lost = jnp.where(enters, exponential(since / (lag * old.pace[None]), SQUARINGS), kept)
    jumps = np.isin(np.arange(len(now)), (DAMPING, FRICTION, PRELOAD))
    entering = jnp.where(_column(jumps, now) > 0, now, 0)
    before = jnp.where(enters[None], entering, old.before)
    fresh = (1 - lost)[None] * (0.5 * (before + now))
    return kept[None] * old.held + jnp.where((pushes | was)[None], fresh, 0), pushes


def weigh(bank: Bank, damping: Array) -> Float[Array, "hypotheses *batch"]:
    """Weights of the hypotheses; their sum is 1."""
    per_second = (bank.pace * bank.pace)[None]
    own = bank.maps.covariance[DAMPING, DAMPING] * per_second
    precision = 1 / jnp.where(own > 0, own, 1)
    total = bank.precision + precision
    mean = (bank.weighted + precision * (bank.maps.mean[DAMPING] * bank.pace[None])) / total
    variance = BROADENING * (bank.met[None] + 1) / total
    plausible = plausibility(mean, variance, damping[None] * per_second)
    plausible = jnp.where(own > 0, jnp.where(plausible > LEAST_CARRIED, plausible, LEAST_CARRIED), 1)
    weights = _weighed(bank.carried, bank.likelihood * (plausible * bank.likely))
    return weights / jnp.sum(weights, axis=0, keepdims=True)


def _weighed(carried: Array, evidence: Array) -> Float[Array, "hypotheses *batch"]:
    """What is carried, by this contact's evidence. Whether it is a lag only maps whose slopes wander decide,
    as those of lags do: the sum over delays is what it would be if all were such."""
    weights = carried * evidence
    wandering, steady = carried[:DELAYS], carried[DELAYS:FIRST_LAG]
    delayed, as_lags = weights[:FIRST_LAG], (wandering + steady) * evidence[:DELAYS]
    # Next to a lag all of them may be next to nothing, whose square is none.
    most = lax.stop_gradient(jnp.max(delayed, axis=0, keepdims=True))
    ratio = jnp.sum(as_lags / most, axis=0) / jnp.sum(delayed / most, axis=0)
    return jnp.concatenate([delayed * ratio[None], weights[FIRST_LAG:]])


def plausibility(mean: Array, variance: Array, prior: Array) -> Float[Array, "*batch"]:
    """How much better a damping N(mean, variance) [1/s] goes with one that is 0 or not negative than one
    N(0, prior) does; Phi as in `positive_mean`."""
    spread = jnp.sqrt(variance)
    ratio = mean / spread
    density = exponential(0.5 * ratio**2, DENSITY_SQUARINGS)
    prior = jnp.where(prior > 0, prior, 1)
    return ELASTIC * (jnp.sqrt(prior) / spread) * density + (1 - ELASTIC) * (2 * cumulative(ratio))


def knots_of(bank: Bank) -> Float[Array, "segments hypotheses *batch"]:
    """Where the knots of each map are [s]."""
    usual = jnp.asarray(KNOTS.reshape(-1, *[1] * bank.farther.ndim), bank.farther.dtype)
    return usual + bank.farther[None] * jnp.minimum(usual / WHOLE, 1)


def average(maps: Map, weights: Float[Array, "hypotheses *batch"], knots: Array) -> Curve:
    """What counts of the maps, by their weights; of the force at the usual knots."""
    own, preload = maps.mean[:SEGMENTS], maps.mean[PRELOAD]
    usual = jnp.asarray(KNOTS.reshape(-1, *[1] * weights.ndim), weights.dtype)
    reached = jnp.concatenate([preload[None], own[:-1] * jnp.diff(knots, axis=0)])
    past = usual - knots
    there = jnp.where(past < 0, jnp.concatenate([own[:1], own[:-1]]), own)
    at_knots = jnp.sum(weights[None] * (jnp.cumsum(reached, axis=0) + past * there), axis=1)
    slopes = jnp.diff(at_knots, axis=0) / jnp.diff(usual[:, 0], axis=0)
    slopes = jnp.concatenate([slopes, jnp.sum(weights * own[-1], axis=0)[None]])
    lost = (
        jnp.sum(positive_mean(maps.mean[i], maps.covariance[i, i]) * weights, axis=0) for i in PLACES[:-1]
    )
    return Curve(slopes, *lost, preload=at_knots[0])


def _means(bank: Bank, weights: Array, supposed: Supposed) -> Bank:
    """With the mean delay and surface."""
    shift = jnp.sum(weights * supposed.older, axis=0)
    shift = jnp.where((shift > LEAST_SHIFT) | (shift < -LEAST_SHIFT), shift, 0)
    return bank._replace(shift=shift, deeper=jnp.sum(weights * bank.below, axis=0))


class _Placed(NamedTuple):
    """Where each hypothesis has the surface."""

    below: Array  # by how much deeper than it was met [s]
    farther: Array  # by how much farther in its knots are than usual [s]
    likely: Array  # how likely it is there
    preload: Array  # variance of the force at the entry [1/s^2]
    entry: Entry  # by delays


def _place(
    meeting: Meeting,
    window: Window,
    offsets: Array,
    speed: Array,
    pace: Array,
    tick: Array,
    plane_spread: Array,
    true: Array,
    lagged: tuple[Array, Array],
) -> _Placed:
    """Between where it was met, with a lag so much later and so uncertain [s, s^2], and where it was told,
    or, where these disagree, where it was met. With a lag the force at the entry is known to what the
    stiffness makes of the uncertain place; of delays the entry is weighed (`entry`). `true`: the variance of
    a true preload [1/s^2]."""
    length = speed / pace
    known = plane_spread**2
    none = jnp.zeros_like(offsets[:FIRST_LAG])
    met = meeting.place[None] + jnp.concatenate([none, lagged[0] * length[None]])
    around = meeting.variance[None] + jnp.concatenate([none, lagged[1] * (length * length)[None]])
    away = met - offsets * speed[None]
    both = known[None] + around
    elsewhere = away * away > NOT_THERE * both
    share = jnp.where(elsewhere, 1, known[None] / both)
    likely = exponential(0.5 * (away * away / both), DENSITY_SQUARINGS)
    place = share * away
    positive = around > 0
    spread = jnp.where(positive, jnp.sqrt(jnp.where(positive, around, 1)), 0) / length[None]
    step = (offsets[1] - offsets[0]) * pace
    placed = (away - place)[:FIRST_LAG], place[:FIRST_LAG]
    entry = enter(meeting, window, length, tick, *placed, known, true, step)
    off = USUAL * (share * (meeting.stiffness[None] * spread))
    off = jnp.concatenate([none + entry.preload[None], off[FIRST_LAG:]])
    return _Placed(
        below=(place - meeting.scales.plane[None]) / length[None],
        farther=jnp.clip((meeting.place[None] - place) / length[None], -FARTHEST, FARTHEST),
        likely=jnp.where(likely > UNLIKELY, likely, UNLIKELY),
        preload=off**2,
        entry=entry,
    )


def _shares(values: Array, least: float) -> Array:
    """Of their sum, at least so much."""
    values = jnp.where(values < NOTHING, 0, values)
    shares = values / jnp.sum(values, axis=0, keepdims=True)
    return jnp.where(shares > least, shares, least)


def _priors(prior: Map) -> Map:
    """Of each hypothesis, as its slopes wander or hardly do; at depth 0 they are as uncertain either way."""
    slopes = np.arange(len(prior.mean)) < SEGMENTS
    share = np.where(np.outer(slopes, slopes), STEADY**2, 1.0)
    share = jnp.asarray(share.reshape(*share.shape, *[1] * (prior.mean.ndim - 1)), prior.mean.dtype)
    steady = share * prior.covariance + (1 - share) * prior.covariance[:1, :1]
    covariance = [prior.covariance] * DELAYS + [steady] * DELAYS + [prior.covariance] * LAGS
    return Map(jnp.stack([prior.mean] * HYPOTHESES, axis=1), jnp.stack(covariance, axis=2))


def _column(values: np.ndarray, like: Array) -> Array:
    """One of each hypothesis, or lag, or parameter, along the first axis of the like."""
    return jnp.asarray(values.reshape(-1, *[1] * (like.ndim - 1)), like.dtype)
