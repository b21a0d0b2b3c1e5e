"""Hypotheses of the force delay and of a lag side by side, each with a force-depth map, weighed by what they
explain.

Hypothesis h takes the force to be d_h [s] older than given: it belongs to the depth X - d_h V - p_h. The
surface was met at X_0; by this hypothesis it lies at p_h = g (X_0 - d_h v_0) beyond where it was told, g =
spread^2/(spread^2 + found^2) by how uncertain either is, or 1 where they disagree. As many others take the
sensor to lag by l_h [s]: what the force is linear in is smoothed alike, and the surface was met where
`lagged_onset` has it. To first order a lag is a delay: these count as l_h older. Each delay is there twice,
by slopes that wander and by slopes that hardly do. Each hypothesis identifies a force-depth map
(`force_depth_map`); its weight is the product of the likelihoods of all readings of this contact and of those
before, of how well its damping goes with what is known of contacts, and of how likely its surface is there,
of delays by `entry` (notebooks/guide/retrospective_reference.md section 7). What counts is the mean over all
hypotheses, of their maps, delays and surfaces. Their maps bend at the same places, wherever they have the
surface: which fits best is not to be decided by what a contact that bends between two knots leaves. In
NumPy, all hypotheses at a time; sums are taken one term after another.
"""

from math import ceil, pi, sqrt

import numpy as np

from .contact_plane import Meeting
from .entry import (
    DENSITY_SQUARINGS,
    NOT_THERE,
    UNLIKELY,
    Entry,
    Readings,
    agree,
    cumulative,
)
from .force_depth_map import (
    DAMPING,
    DEPTH_DAMPING,
    FRICTION,
    JUMPS,
    KNOTS,
    PARAMETERS,
    PRELOAD,
    REACH,
    SEGMENTS,
    SURFACE,
    UNLOADING,
    Curve,
    Prior,
    turning,
)
from .hypotheses import DELAYED, DELAYS, FIRST_LAG, HYPOTHESES, LAGGING, LAGS, suppose
from .lagged_onset import FARTHEST, USUAL, WHOLE
from .lagged_onsets import lagged_onsets
from .onset import SQUARINGS, exponential

STEADY = 0.125  # of the spread by which slopes wander, where they hardly do
ELASTIC = 0.35  # probability that a contact has no damping
BROADENING = 2.0  # of the variance of the damping, as the delay lies between two hypotheses
# The least share of a likelihood, within a contact and of those before: what they rule out can come back.
LEAST, LEAST_CARRIED = 1e-200, 1e-12
NOTHING = 1e-300  # a smaller product is none: some machines keep such numbers, some do not
LEAST_SHIFT = 1e-12  # s: where nothing tells delays apart, rounding does not either
BEYOND_NOISE = 9.0  # times its variance: a force that is more than noise
EARLIER = 30  # ticks before it was met, whose readings count
EDGE = 0.6  # probability that it is a farthest delay or the longest lag: then it may lie beyond
OPEN = 0.0075  # of a restitution of 1, that what is open of the delay makes
SETTLED = 0.99  # probability from which on it is a lag

_KNOTS = np.array(KNOTS)[:, None]
_GAPS = np.diff(KNOTS)
_MOVED = np.minimum(np.array(KNOTS) / WHOLE, 1.0)[:, None]
# Beside an array, a number takes longer than an array does.
_0, _1 = np.zeros(HYPOTHESES), np.ones(HYPOTHESES)
_JUMPS = np.isin(np.arange(PARAMETERS), JUMPS)[:, None]


class DelayBank:
    """The bank, made of how far [s] the farthest hypotheses lie from the given delay, of the lag [s] of the
    force sensor that is told, of how uncertain it is where the surface was told [m], of the map's prior, and
    of the control period [s]."""

    __slots__ = (
        "_before", "_below", "_carried", "_covariance", "_damping", "_deepest", "_edge", "_entry",
        "_estimate", "_held", "_kept", "_knots", "_known", "_lagging", "_learning", "_likelihood", "_likely",
        "_met", "_met_at", "_off", "_pace", "_past", "_period", "_plane_spread", "_precision",
        "_prior_covariance", "_prior_estimate", "_pushed", "_supposed", "_weighted", "_widths", "_within",
        "curve", "deeper", "shift", "variance",
    )  # fmt: skip

    def __init__(
        self, spread: float, sensor_lag: float, plane_spread: float, prior: Prior, period: float
    ) -> None:
        self._supposed = suppose(spread, sensor_lag)
        self._period = period
        # Of what a lagging sensor shows, after a tick.
        self._kept = exponential(period / self._supposed.lags, SQUARINGS)
        self._plane_spread = plane_spread
        self._damping = prior.damping * prior.damping
        estimate, covariance = prior.moments()
        self._prior_estimate = np.repeat(np.array(estimate)[:, None], HYPOTHESES, axis=1)
        steady = prior._replace(wandering=STEADY * prior.wandering).moments()[1]
        self._prior_covariance = np.repeat(np.array(covariance)[:, :, None], HYPOTHESES, axis=2)
        self._prior_covariance[:, :, DELAYS:FIRST_LAG] = np.array(steady)[:, :, None]
        self.curve = Curve()  # the mean of the maps
        self.reset()

    def reset(self) -> None:
        """Forget all contacts."""
        self._restart()
        self._carried = self._supposed.first
        self._precision = np.zeros(HYPOTHESES)
        self._weighted = np.zeros(HYPOTHESES)
        self._below = np.zeros(HYPOTHESES)  # by how much deeper each has the surface than it was met [s]
        self._likely = np.ones(HYPOTHESES)  # how likely it is there
        self._within = np.zeros(HYPOTHESES)  # how deep it is by the map [s]
        self._met_at = 0.0  # how deep it was met [s]
        self._entry = None
        self._bend(np.zeros(HYPOTHESES))
        self._met = 0.0
        self._pace = 1.0
        self._off = 0.0  # standard deviation of the delays [s]
        self._edge = 0.0  # the largest weight of what may lie beyond
        self._lagging = 0.0  # the weight of all lags that are not told
        self.shift = 0.0  # the mean of the hypotheses' delays [s]
        self.deeper = 0.0  # and of how much deeper the surface is [s], on the contact's scale of time

    @np.errstate(all="ignore")
    def begin(self, meeting: Meeting, depths: list[float], forces: list[float], variance: float) -> int:
        """A contact begins: the one before is added to what is carried, and the maps are the prior. From how
        many ticks before the meeting on to learn from the readings; the newest of them, at depths [s] beyond
        where the surface was met, forces [1/s] with a variance [1/s^2]."""
        if self._learning:
            pace = self._pace
            own = self._covariance[DAMPING, DAMPING] * (pace * pace)
            precision = 1.0 / np.where(own > 0.0, own, 1.0)
            carried = self._carried if self._met else self._supposed.either
            evidence = self._likelihood * np.where(DELAYED, self._likely, 1.0)
            self._carried = _shares(_weighed(carried, evidence), LEAST_CARRIED)
            self._precision = self._precision + precision
            self._weighted = self._weighted + precision * (self._estimate[DAMPING] * pace)
            self._met += 1.0
        self._pace = meeting.pace
        self._restart()
        first = self._place(meeting, depths, forces, variance)
        self._conclude(self._weigh())
        return min(ceil((first if first > SURFACE else 0.0) / meeting.tick), EARLIER)

    @np.errstate(all="ignore")
    def learn(
        self, depth: float, rate: float, force: float, variance: float, hidden: bool, zone: float
    ) -> None:
        """One reading: depth [s] and speed as old as the force by the given delay, force [1/s], its variance
        [1/s^2], whether the sensor's dead zone hides it, that zone [1/s]."""
        self._read(depth, rate, force, variance, hidden, zone)
        self._conclude(self._weigh())

    def leaves_open(self, peak: float) -> bool:
        """Whether the delay is left open, the restitution of a contact of this peak force [1/s] by it
        [pi/2 p d], may well lie beyond all hypotheses, or be a lag: readings that speak for one, if not so
        clearly that its being rare is outweighed."""
        lagging = self._lagging
        doubtful = SETTLED > lagging > LAGGING * (1.0 - lagging)
        return doubtful or self._edge > EDGE or 0.5 * pi * (peak * (self._off * self._pace)) > OPEN

    def _place(self, meeting: Meeting, depths: list[float], forces: list[float], variance: float) -> float:
        """Each hypothesis has the surface between where it was met, with a lag so much later and with a
        variance of its own, and where it was told, or, where these disagree, where it was met. With a lag the
        force at the entry is known to what the stiffness makes of the uncertain place; of delays the entry is
        weighed (`entry`). How far [s] the hardware was in, by the first to enter, as it was met."""
        length = meeting.speed / meeting.pace
        later, spreads = lagged_onsets(
            self._supposed.lags * meeting.pace, depths, forces, variance, meeting.tick
        )
        known = self._plane_spread * self._plane_spread
        met = np.append(_1[:FIRST_LAG] * meeting.place, meeting.place + later * length)
        around = np.append(_1[:FIRST_LAG] * meeting.variance, spreads * (length * length) + meeting.variance)
        away = met - self._supposed.offsets * meeting.speed
        both = known + around
        elsewhere = away * away > NOT_THERE * both
        share = np.where(elsewhere, 1.0, known / both)
        likely = exponential(0.5 * (away * away / both), DENSITY_SQUARINGS)
        places = share * away
        off = USUAL * (share * (meeting.stiffness * (np.sqrt(around) / length)))
        self._entry = Entry.of(
            meeting, Readings(depths, forces, variance), (away - places)[:FIRST_LAG], places[:FIRST_LAG],
            known, float(self._prior_covariance[PRELOAD, PRELOAD, 0]),
            self._supposed.step * meeting.pace,
        )  # fmt: skip
        off[:FIRST_LAG] = self._entry.preload
        self._covariance[PRELOAD, PRELOAD] += off * off
        self._below = (places - meeting.plane) / length
        self._bend(np.minimum(np.maximum((meeting.place - places) / length, -FARTHEST), FARTHEST))
        self._likely = np.where(likely > UNLIKELY, likely, UNLIKELY)
        self._met_at = (meeting.place - meeting.plane) / length
        inside = meeting.plane - places - self._supposed.offsets * meeting.speed
        return float(np.maximum.reduce(inside[FIRST_LAG:] / length))

    def _bend(self, farther: np.ndarray) -> None:
        """The knots of each map lie so much farther in [s] than usual."""
        self._knots = _KNOTS + farther * _MOVED
        self._widths = np.append(self._knots[1:] - self._knots[:-1], np.full((1, HYPOTHESES), np.inf), axis=0)
        self._past = _KNOTS - self._knots

    def _restart(self) -> None:
        """Another contact: the maps are the prior, nothing has been read."""
        self._learning = False
        self._estimate = self._prior_estimate.copy()
        self._covariance = self._prior_covariance.copy()
        self._deepest = np.zeros(HYPOTHESES)
        # What is smoothed, as it was before that, and whether the contact then pushed.
        self._held = self._before = np.zeros((PARAMETERS, LAGS))
        self._pushed = np.zeros(LAGS, dtype=bool)
        self._known = np.zeros(HYPOTHESES)
        self.variance = 0.0  # of the force that each expects where it was read last [1/s^2]
        self._likelihood = np.ones(HYPOTHESES)

    def _read(
        self, depth: float, rate: float, force: float, variance: float, hidden: bool, zone: float
    ) -> None:
        estimate = self._estimate
        depths = depth - self._supposed.offsets * self._pace * rate - self._below
        deepest = np.fmax(self._deepest, depths)
        phi = self._features(depths, rate, deepest)
        # Of a delay, the surface may lie before where its map has it.
        phi[0, :FIRST_LAG] = np.minimum(depths, self._widths[0])[:FIRST_LAG]
        self._smooth(depths[FIRST_LAG:], rate, phi)
        read = force
        noise = variance
        if hidden:
            force = 0.5 * zone
            read = 0.0
            noise = variance + zone * zone / 12.0
        # Rows and columns are exchanged in memory: only so are sums over rows both quick and in order.
        g = np.add.reduce(self._covariance * phi[:, None], axis=0)
        expected = np.add.reduce(phi * estimate, axis=0)
        s = noise + np.add.reduce(phi * g, axis=0)
        positive = expected > _0
        closes = rate > 0.0
        inside = depths - self._within > SURFACE
        if closes:
            inside[:FIRST_LAG] = depth - self._met_at > SURFACE
        inside[FIRST_LAG:] = True
        if hidden:
            inside &= expected > zone
        used = inside & (s > _0)
        used[FIRST_LAG:] &= self._pushed
        if not closes and not force * force > BEYOND_NOISE * noise:
            used &= positive
        nothing = ~inside
        if not closes:
            nothing |= ~positive
        innovation = force - expected
        wide = np.where(nothing, noise, s)
        wide = np.where(wide > _0, wide, _1)
        missed = np.where(nothing, read, innovation)
        surprise = 0.25 * (missed * missed) / wide
        surprise -= np.minimum.reduce(surprise)
        sharpness = np.sqrt(np.sqrt(np.fmin(noise / wide, _1)))
        likelihood = self._likelihood * sharpness * exponential(surprise, SQUARINGS)
        self._likelihood = _shares(likelihood, LEAST)
        self._deepest = deepest
        self._learning = True
        share = _1 / np.where(used, s, _1)
        self._known = np.where(used, noise * ((s - noise) * share), self._known)
        scaled = share * g
        correction = scaled * innovation
        less = g[:, None] * scaled
        if not np.logical_and.reduce(used):
            correction = np.where(used, correction, 0.0)
            less = np.where(used, less, 0.0)
        self._estimate = estimate + correction
        self._covariance -= less

    def _features(self, depths: np.ndarray, rate: float, deepest: np.ndarray) -> np.ndarray:
        """What the force is linear in, by each hypothesis."""
        phi = np.empty((PARAMETERS, HYPOTHESES))
        phi[:SEGMENTS] = np.fmax(np.minimum(depths - self._knots, self._widths), _0)
        phi[DAMPING] = rate
        phi[DEPTH_DAMPING] = depths * rate / REACH
        phi[UNLOADING] = depths - deepest
        phi[FRICTION] = turning(rate)
        phi[PRELOAD] = 1.0
        return phi

    def _smooth(self, depths: np.ndarray, rate: float, phi: np.ndarray) -> None:
        """As a sensor that lags shows it: of phi the mean over the tick, from the entry on where that is
        within it, as long as the contact pushes."""
        now = phi[:, FIRST_LAG:].copy()
        pushes = depths > SURFACE
        since = self._period * self._pace
        if rate > 0.0:
            since = np.fmin(depths / rate, since)
        else:
            since = _0[:LAGS]
            pushes &= np.add.reduce(now * self._estimate[:, FIRST_LAG:], axis=0) > 0.0
        enters = pushes & ~self._pushed
        kept = self._kept
        lost = np.where(enters, exponential(since / (self._supposed.lags * self._pace), SQUARINGS), kept)
        before = np.where(enters, np.where(_JUMPS, now, 0.0), self._before)
        fresh = (1.0 - lost) * (0.5 * (before + now))
        self._held = kept * self._held + np.where(pushes | self._pushed, fresh, 0.0)
        phi[:, FIRST_LAG:] = self._held
        self._before = now
        self._pushed = pushes

    def _weigh(self) -> np.ndarray:
        """Weights of the hypotheses; their sum is 1."""
        pace = self._pace
        own = self._covariance[DAMPING, DAMPING] * (pace * pace)
        precision = _1 / np.where(own > _0, own, _1)
        total = self._precision + precision
        mean = (self._weighted + precision * (self._estimate[DAMPING] * pace)) / total
        variance = BROADENING * (self._met + 1.0) / total
        plausible = _plausibility(mean, variance, self._damping * (pace * pace))
        plausible = np.where(own > _0, np.fmax(plausible, LEAST_CARRIED), _1)
        self._enter()
        weights = _weighed(self._carried, self._likelihood * (plausible * self._likely))
        return weights / _total(weights)

    def _enter(self) -> None:
        """What the maps of delays say of the entry."""
        if self._entry is not None:
            delays = self._estimate[:, :FIRST_LAG], self._covariance[:, :, :FIRST_LAG]
            entered = agree(self._entry, *delays)
            self._within[:FIRST_LAG] = entered.place
            self._likely[:FIRST_LAG] = entered.likely

    def _conclude(self, weights: np.ndarray) -> None:
        """The mean over the hypotheses, by their weights."""
        supposed = self._supposed
        shift = float(_total(weights * supposed.older))
        off = supposed.older - shift
        self._lagging = float(_total(weights[supposed.untold :]))
        # Between two lags neither is right.
        between = 0.5 * (supposed.lag_step * supposed.lag_step) * self._lagging
        self._off = sqrt(_total(weights * (off * off)) + between)
        newest = float(weights[0] + weights[DELAYS])
        oldest = float(weights[DELAYS - 1] + weights[FIRST_LAG - 1])
        if supposed.untold > FIRST_LAG:
            newest += float(weights[FIRST_LAG])
            oldest += float(weights[supposed.untold - 1])
        self._edge = max(float(weights[-1]), newest, oldest)
        self.shift = shift if shift > LEAST_SHIFT or shift < -LEAST_SHIFT else 0.0
        self.deeper = float(_total(weights * self._below))
        self.variance = float(_total(weights * self._known))
        estimate = self._estimate
        # The force at each map's own knots, then at the usual ones.
        slopes = estimate[:SEGMENTS]
        steps = np.concatenate((estimate[PRELOAD:], slopes[:-1] * self._widths[:-1]))
        there = np.where(self._past < _0, np.concatenate((slopes[:1], slopes[:-1])), slopes)
        forces = weights * (np.add.accumulate(steps, axis=0) + self._past * there)
        at_knots = np.add.accumulate(forces, axis=1)[:, -1]
        last = float(_total(weights * slopes[-1]))
        # Without a copy.
        diagonal = self._covariance.reshape(-1, HYPOTHESES)[:: PARAMETERS + 1]
        lost = _positive_mean(estimate[DAMPING:PRELOAD], diagonal[DAMPING:PRELOAD]) * weights
        curve = self.curve
        curve.slopes = [*((at_knots[1:] - at_knots[:-1]) / _GAPS).tolist(), last]
        curve.at_knots = at_knots.tolist()
        losses = np.add.accumulate(lost, axis=1)[:, -1].tolist()
        curve.damping, curve.depth_damping, curve.unloading, curve.friction = losses


def _plausibility(mean: np.ndarray, variance: np.ndarray, prior: float) -> np.ndarray:
    """How much better a damping N(mean, variance) goes with one that is 0 or not negative than one
    N(0, prior) does; Phi as in `force_depth_map.positive_mean`."""
    spread = np.sqrt(variance)
    ratio = mean / spread
    density = exponential(0.5 * (ratio * ratio), DENSITY_SQUARINGS)
    known = sqrt(prior if prior > 0.0 else 1.0)
    return ELASTIC * (known / spread) * density + (1.0 - ELASTIC) * (2.0 * cumulative(ratio))


def _positive_mean(mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """`force_depth_map.positive_mean` of many."""
    known = variance > _0
    spread = np.sqrt(np.where(known, variance, _1))
    ratio = mean / spread
    root = np.sqrt(ratio * ratio + 2.0 * pi)
    below = 2.0 / (root - ratio)
    above_0 = ratio > _0
    positive = np.where(above_0, ratio, _0)
    mills = pi / ((pi - 1.0) * positive + root)
    tail = 1.0 / (1.0 + positive * positive / 512.0)
    for _ in range(8):
        tail *= tail
    density = tail / sqrt(2.0 * pi)
    above = positive + density / (1.0 - density * mills)
    return np.where(known, spread * np.where(above_0, above, below), np.fmax(mean, _0))


def _weighed(carried: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """What is carried, by this contact's evidence. Whether it is a lag only maps whose slopes wander decide,
    as those of lags do: the sum over delays is what it would be if all were such."""
    weights = carried * evidence
    as_lags = (carried[:DELAYS] + carried[DELAYS:FIRST_LAG]) * evidence[:DELAYS]
    weights[:FIRST_LAG] *= _total(as_lags) / _total(weights[:FIRST_LAG])
    return weights


def _shares(values: np.ndarray, least: float) -> np.ndarray:
    """Of their sum, at least so much."""
    values = np.where(values < NOTHING, 0.0, values)
    shares = values / _total(values)
    return np.fmax(shares, least)


def _total(values: np.ndarray) -> float:
    """The sum, one term after another."""
    return np.add.accumulate(values)[-1]
