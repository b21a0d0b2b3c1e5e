"""Check of the dead zone's kind: continuous (subtracted from every force) or cut (small forces read 0)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from jaxhil.mechanism.structs import Mechanism
from tuning.identification.contact_fit import ContactFit
from tuning.identification.cut_zone import take_readings_before_contact
from tuning.identification.records import LoggedRun
from tuning.identification.validation import CheckResult

MIN_CONTACTS_FOR_DEAD_ZONE = 5  # minimum number of contacts for the check of small readings
MAX_NONZERO_SHARE = 0.8  # maximum share of nonzero readings with a dead zone
CUTTING_DEAD_ZONE_P_VALUE = 0.01  # maximum p-value that shows a dead zone which is not subtracted
# A dead zone hides the noise out of contact if it is larger than this number of standard deviations.
MIN_SMALL_READING_SIGMAS = 3.0
# Error of the number of readings inside a cut zone. In simulated campaigns, the error of e was at most 2.5
# times the effect of one reading.
SHIFTED_TICKS = 3.0
MIN_READINGS_OUTSIDE_ZONE = 20  # minimum expected number of readings that exceed a stated zone
ZONE_TOLERANCE = 0.1  # maximum error of a stated size, divided by the size
MIN_OUTSIDE_SHARE = 0.2  # minimum ratio of readings that exceed a stated zone to their expected number
BIAS_SIGMAS = 3.0  # maximum error of the bias in the check of zeros, in standard deviations
MIN_READINGS_AT_REST = 100  # minimum number of readings without contact for the check of zeros
# Maximum error of the expected share of zeros: the noise may be correlated, and the bias may drift.
MAX_ZERO_SHARE_ERROR = 0.2


def check_cut_dead_zone(contact: ContactFit, runs: list[LoggedRun]) -> list[CheckResult]:
    """Check for a cut dead zone of the force sensor, which replaces small forces by 0 and keeps larger ones.

    Only contacts with many readings of 0 are evaluated. If all their other readings are large, the zone is
    cut. (A continuous dead zone is also subtracted from larger forces, so small readings remain.) If the
    mechanism file states a cut zone, the readings are checked against that zone instead.
    """
    delay, plane, coefficient_fit = contact.posterior.best
    touching = contact.problem.touching(delay, plane, coefficient_fit.coefficients)
    if contact.readings.zone:
        return _check_stated_cut_zone(contact, touching)
    steps, peaks, sizes, outside = [], [], [], []
    for lane, run in enumerate(runs):
        force = np.abs(contact.readings.force[: len(run.tick), lane])
        (nonzero,) = np.nonzero(force)
        if run.kind == "contact" and len(nonzero) > 1 and len(nonzero) < MAX_NONZERO_SHARE * len(force):
            steps.append(abs(force[nonzero[-1]] - force[nonzero[-2]]))
            peaks.append(force.max())
            sizes.append(force[nonzero])
            outside.append(force[nonzero[~touching[nonzero, lane]]])
    if len(peaks) < MIN_CONTACTS_FOR_DEAD_ZONE:
        return []
    least, std = min(size.min() for size in sizes), contact.readings.std
    quantum = np.diff(np.unique(contact.readings.force)).min(initial=np.inf)
    # In a smooth release, the last reading is assumed to be uniform between 0 and the last step.
    probability = np.prod(np.maximum(1.0 - least / (np.array(steps) + 2.0 * std + 1e-300), 0.0))
    if least <= MIN_SMALL_READING_SIGMAS * std:
        # Beyond a zone that is subtracted, the noise becomes rarer with size. Each reading of at most twice
        # the smallest one then has a probability of at least 1/2 to be smaller than the smallest one.
        probability = 0.5 ** np.count_nonzero(np.concatenate(outside) <= 2.0 * least)
    if least <= 2.5 * quantum or probability > CUTTING_DEAD_ZONE_P_VALUE:
        return []
    finding = f"no reading lies between 0 and {least:.2g} N, as with a dead zone that is not subtracted"
    return [CheckResult("dead zone of the force sensor", finding, True, float(least / np.median(peaks)))]


def check_zone_sampling(mechanism: Mechanism) -> list[CheckResult]:
    """Return how the restitution changes if a force crosses the limit of a cut dead zone some ticks later.

    The readings of each contact begin and end with a jump by the size of the zone. A jump one tick later
    changes the impulse by size * control period. Small errors of delay and surface position move the jumps to
    another tick.
    """
    rig, size = mechanism.rig, mechanism.rig.force_sensor.dead_zone
    if rig.force_sensor.dead_zone_kind != "cut" or size == 0.0:
        return []
    effect = SHIFTED_TICKS * size * rig.control_period / mechanism.bodies.mass / mechanism.approach.velocity
    finding = f"readings jump by {size:.2g} N, and the tick of the jump differs from contact to contact"
    return [CheckResult("sampling of the dead zone", finding, True, effect)]


def check_zeros_at_rest(
    contact: ContactFit, mechanism: Mechanism, runs: Sequence[LoggedRun]
) -> list[CheckResult]:
    """Check that a continuous dead zone and the bias explain how many readings are 0 without contact.

    A reading is 0 if the force with bias and noise lies inside the zone. If the zone of the file is too
    small, the fit explains the missing force in contact by a bias, which readings of 0 at rest contradict.
    """
    sensor = mechanism.rig.force_sensor
    if not sensor.dead_zone or sensor.dead_zone_kind == "cut" or sensor.bias_random_walk:
        return []
    readings = [np.zeros(0)]
    for run in runs:
        if run.force_measured is not None and run.kind == "contact":
            readings.append(take_readings_before_contact(run))
        elif run.force_measured is not None and run.kind in ("rest", "free"):
            readings.append(run.valid_forces)
    is_zero = np.concatenate(readings) == 0.0
    if len(is_zero) < MIN_READINGS_AT_REST:
        return []
    share = float(np.mean(is_zero))
    entries = [mechanism.uncertainty.get(f"rig.force_sensor.{key}") for key in ("bias", "dead_zone")]
    stds = [entry.std for entry in entries if entry is not None]
    if None in stds:
        return []
    error = BIAS_SIGMAS * float(np.linalg.norm(np.array(stds, float)))
    # Rounding has the effect of a larger zone.
    zone, std = sensor.dead_zone + 0.5 * sensor.quantum, max(sensor.noise_std, 1e-12)
    size = abs(sensor.bias)
    bias = np.array([max(size - error, 0.0), size, size + error])
    expected = special.ndtr((zone - bias) / std) - special.ndtr((-zone - bias) / std)
    if expected.min() - MAX_ZERO_SHARE_ERROR <= share <= expected.max() + MAX_ZERO_SHARE_ERROR:
        return []
    finding = f"{share:.0%} of the readings without contact are 0, expected {expected[1]:.0%} with a bias of "
    finding += f"{sensor.bias:.2g} N"
    peaks = np.abs(contact.readings.force).max(axis=0)
    effect = max(zone, size) / float(np.median(peaks[peaks > 0.0])) if peaks.any() else 1.0
    return [CheckResult("dead zone of the force sensor", finding, True, effect)]


def _check_stated_cut_zone(contact: ContactFit, touching: np.ndarray) -> list[CheckResult]:
    """Check the readings against a stated cut dead zone, which replaces forces below its size by 0.

    Nonzero readings must exceed the zone. Out of contact, noise must exceed the zone often enough.
    """
    readings, name = contact.readings, "dead zone of the force sensor"
    outside = readings.force[readings.is_valid & ~touching]
    expected = 2.0 * special.ndtr(-readings.zone / readings.std) * len(outside)
    count = np.count_nonzero(outside)
    if expected >= MIN_READINGS_OUTSIDE_ZONE and count < MIN_OUTSIDE_SHARE * expected:
        finding = f"{count} readings out of contact are not 0, expected {expected:.0f} with a cut zone of "
        return [CheckResult(name, f"{finding}{readings.zone:.2g} N", True, 1.0)]
    sizes = np.abs(readings.force)
    least = float(sizes[sizes > 0.0].min(initial=np.inf))
    if expected < MIN_READINGS_OUTSIDE_ZONE:
        finding = f"a cut zone of {readings.zone:.2g} N hides it, and the onset of contact depends on it"
        return [CheckResult("bias of the force sensor", finding, True, 1.0)]
    if readings.zone - least <= max(readings.std, ZONE_TOLERANCE * readings.zone):
        return []
    finding = f"found a reading of {least:.2g} N, expected none inside a cut zone of {readings.zone:.2g} N"
    return [CheckResult(name, finding, True, float((readings.zone - least) / np.median(sizes.max(axis=0))))]
