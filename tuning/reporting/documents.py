"""Structs for the JSON documents that commands write, with the fields that a report shows.

A file that lacks a field, or whose field has another type, cannot be converted to these structs.
"""

from msgspec import Struct


class ProbabilityEntry(Struct):
    """Probability with a 95 % confidence interval."""

    value: float
    low: float
    high: float
    method: str = ""


class QuantileEntry(Struct):
    """Quantile of the scenarios' worst |e - e*| in a sweep."""

    order: float  # order of the quantile, 0 to 1
    value: float | None = None  # quantile [1]; None if it is infinite
    low: float | None = None  # lower end of the 95 % interval [1]
    high: float | None = None  # upper end of the 95 % interval [1]


class WorstScenario(Struct):
    """Outcome and inputs of a scenario with one of the largest errors in a sweep."""

    index: int
    outcome: str
    worst_error: float | None = None  # e - e* of largest magnitude [1]; None if a contact did not end
    worst_contact: int | None = None  # number of the contact with this error
    inputs: dict[str, float | None] = {}  # drawn values by key of the mechanism file [SI units]


class InputIndicesEntry(Struct):
    """First-order and total Sobol index of an input, with 95 % confidence intervals [1]."""

    input: str  # key of the mechanism file, or several keys that vary together
    first_order: float | None = None
    first_order_low: float | None = None
    first_order_high: float | None = None
    total: float | None = None
    total_low: float | None = None
    total_high: float | None = None


class SobolIndicesEntry(Struct):
    """Sobol indices of the worst error of a scenario, for all inputs."""

    inputs: list[InputIndicesEntry]
    cap: float  # value at which larger errors are clipped [1]
    evaluations: int  # number of simulated scenarios
    capped: int  # number of scenarios whose error was clipped


class SubsetSimulationEntry(Struct):
    """Probability of a rare error, from subset simulation."""

    limit: float  # error above which a scenario fails [1]
    probability: float  # failure probability [1]
    low: float  # lower end of the 95 % interval [1]
    high: float  # upper end of the 95 % interval [1]
    evaluations: int  # number of simulated scenarios
    # coefficient of variation of the estimate, from the replicates [1]
    coefficient_of_variation: float | None = None
    spread_beyond_formula: bool = False  # whether the replicates differ more than the theory predicts


class SweepVerdict(Struct):
    """JSON document verdict.json in the folder of a sweep: failure probability, errors and verdict."""

    sweep_sha256: str
    gains_sha256: str
    mechanism: str
    compensator: str
    scenarios: int
    seed: int
    sampling: str
    precision: str
    failed: int
    failure_probability: ProbabilityEntry
    error_quantiles: list[QuantileEntry]
    outcomes: dict[str, int]
    worst: list[WorstScenario]
    verdict: str
    limit: float | None = None
    until_width: float | None = None
    acceptable: float | None = None
    drivers: SobolIndicesEntry | None = None
    rare: SubsetSimulationEntry | None = None


class EstimateEntry(Struct):
    """Mechanism parameter that was estimated from logs or fixed by the user, in SI units."""

    key: str  # key of the mechanism file
    value: float
    unit: str
    known: bool  # whether the user fixed the value
    std: float | None = None  # standard deviation of the estimate
    low: float | None = None  # lower end of the 95 % interval
    high: float | None = None  # upper end of the 95 % interval
    prior: float | None = None  # value in the prior mechanism file


class CheckEntry(Struct):
    """Result of a check of the logs for one effect that the identified model does not contain."""

    name: str
    finding: str
    there: bool  # whether the effect was detected
    effect: float | None = None  # change of e caused by the effect [1]
    where: str = ""  # log and time of the effect
    counts: bool = True  # whether the effect counts in the verdict


class IdentificationDocument(Struct):
    """JSON document identification.json: estimates, checks of the model, and verdict."""

    estimates: list[EstimateEntry]
    checks: list[CheckEntry]
    effect: float | None  # possible change of e caused by unexplained effects and uncertainty [1]
    limit: float | None  # the verdict is good only if the effect is below this limit [1]
    verdict: str
    reason: str
    notes: list[str]
    sources: dict[str, str]  # SHA-256 digests by name of the log file
    seed: int
    versions: dict[str, str]  # versions of the software by package
    effect_on_error: float | None = None  # possible change of e - e* [1]


class MonitoredMetric(Struct):
    """Metric of a monitored contact; the mean of the metric is 0 if the mechanism file is correct.

    A field is None if the log does not contain enough data for the metric.
    """

    value: float | None
    predicted_std: float | None  # predicted standard deviation of the value
    z: float | None  # (value - predicted value) / predicted_std


class MonitoredContact(Struct):
    """Contact in a log that was recorded after the identification, with its metrics and state."""

    contact: int  # number of the contact, from 1
    log: str
    state: str
    figures: dict[str, MonitoredMetric]  # metrics by name


class MonitoringDocument(Struct):
    """JSON document that `jaxhil monitor --json` prints: contacts with metrics, and state of the rig."""

    mechanism: str  # path of a mechanism file, or name of a built-in mechanism
    mechanism_sha256: str | None
    state: str
    reason: str
    contacts: list[MonitoredContact]
    notes: list[str]
    sources: dict[str, str]
    versions: dict[str, str]
    since: int | None = None  # number, from 1, of the contact at which the rig probably changed


class MetricEntry(Struct):
    """Value of one metric of a compensator, with the 95 % confidence interval of the value, if known."""

    value: float | None = None
    low: float | None = None
    high: float | None = None


class ComparedCompensator(Struct):
    """Metrics of one compensator in a comparison."""

    law: str  # name of the compensator
    figures: dict[str, dict[str, MetricEntry]]  # metrics by name of the gains, then by name of the metric


class ComparedMechanism(Struct):
    """Metrics of all compared compensators for one mechanism."""

    mechanism: str
    laws: list[ComparedCompensator]


class ComparisonDocument(Struct):
    """JSON document compare.json: a comparison of compensators on one or several mechanisms."""

    limit: float | None  # restitution or twist error above which a scenario fails [1]
    seed: int
    scenarios: int  # number of scenarios for the tuning
    judged: int  # number of evaluation scenarios, which are not used for tuning
    tuned: bool  # whether compensators without settings were tuned
    mechanisms: list[ComparedMechanism]
    axes: int = 1  # number of axes of all mechanisms


class AxisOfMap(Struct):
    """Axis of a stability map in map.json."""

    key: str  # key of the mechanism file, or gains.NAME
    unit: str
    nominal: float  # value in the mechanism file
    values: list[float]  # values along the axis, increasing


class Theory(Struct):
    """Values of the closed-form solutions on the grid of a stability map, one row for each value of y.

    A field is None if its closed form does not apply.
    """

    series: list[list[float | None]] | None = None  # restitution from the series [1]
    characteristic_root: list[list[float | None]] | None = None  # restitution from the dominant root [1]
    delay_over_critical: list[list[float | None]] | None = None  # delay divided by the critical delay [1]
    none_because: str | None = None  # reason if no closed form applies


class RadiusOfMap(Struct):
    """Spectral radius of the loop in contact, on a grid that may be coarser than the map's grid."""

    x: list[float] | None = None  # values along x
    y: list[float] | None = None  # values along y
    values: list[list[float]] | None = None  # spectral radii [1], rows along y
    none_because: str | None = None  # reason if there is no spectral radius


class GrowthOfMap(Struct):
    """Growth of the oscillation in a contact that does not end, at the nominal point of a stability map."""

    spectral_radius: float  # growth factor of the amplitude per control period [1]
    per_second: float  # growth rate [1/s]
    frequency: float  # frequency of the oscillation [Hz]
    by_gain: dict[str, float]  # derivative of the spectral radius with respect to each gain
    per_half_oscillation: float | None = None  # growth factor per half oscillation [1]


class MarginOfMap(Struct):
    """Range of one map axis, around the nominal value, in which a condition of `MarginsOfMap` holds."""

    low: float | None = None  # lower end; None if the condition holds down to the end of the map
    high: float | None = None  # upper end; None if the condition holds up to the end of the map


class MarginsOfMap(Struct):
    """Margins of a stability map's nominal point for three conditions.

    Each field has one range for axis "x" and another for axis "y", or is None if the nominal point itself
    violates the condition.
    """

    error: dict[str, MarginOfMap] | None = None  # error within the limit
    contact: dict[str, MarginOfMap] | None = None  # real peak force and duration within their bounds
    spectral_radius: dict[str, MarginOfMap] | None = None  # spectral radius at most 1


class NominalOfMap(Struct):
    """Results at the nominal point of a stability map; the mechanism file defines this point."""

    margins: MarginsOfMap
    restitution: float | None = None  # e of the contact with the largest error [1]
    error: float | None = None  # largest error e - e* [1]; None if a contact did not end
    peak_force_ratio: float | None = None  # largest peak force divided by the ideal contact's [1]
    duration_ratio: float | None = None  # duration divided by the ideal contact's, farthest from 1 [1]
    growth: GrowthOfMap | None = None


class MapDocument(Struct):
    """JSON document map.json: a stability map with theory and margins."""

    mechanism: str
    compensator: str
    gains: dict[str, float]
    x: AxisOfMap
    y: AxisOfMap
    seed: int
    error: list[list[float | None]]
    restitution: list[list[float | None]]
    theory: Theory
    spectral_radius: RadiusOfMap
    nominal: NominalOfMap
    limit: float | None = None
    peak_force_ratio: list[list[float | None]] | None = None
    duration_ratio: list[list[float | None]] | None = None
    axes: int = 1  # number of axes of the rig
