"""Structs for the documents of commands, with the fields that a report shows; wrong files do not fit them."""

from msgspec import Struct


class ProbabilityEntry(Struct):
    """Probability with a 95 % confidence interval."""

    value: float
    low: float
    high: float
    method: str = ""


class QuantileEntry(Struct):
    """Quantile of the worst |e - e*| of a scenario; None if it is infinite."""

    order: float
    value: float | None = None
    low: float | None = None
    high: float | None = None


class WorstScenario(Struct):
    """One of the worst scenarios of a sweep."""

    index: int
    outcome: str
    worst_error: float | None = None
    worst_contact: int | None = None
    inputs: dict[str, float | None] = {}


class InputIndicesEntry(Struct):
    """Sobol indices of an input, with their confidence intervals."""

    input: str
    first_order: float | None = None
    first_order_low: float | None = None
    first_order_high: float | None = None
    total: float | None = None
    total_low: float | None = None
    total_high: float | None = None


class SobolIndicesEntry(Struct):
    """Sobol indices of the error."""

    inputs: list[InputIndicesEntry]
    cap: float
    evaluations: int
    capped: int


class SubsetSimulationEntry(Struct):
    """Result of a subset simulation."""

    limit: float
    probability: float
    low: float
    high: float
    evaluations: int
    coefficient_of_variation: float | None = None
    spread_beyond_formula: bool = False


class SweepVerdict(Struct):
    """Document verdict.json of a sweep's store."""

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
    """Parameter that was identified, or known beforehand."""

    key: str
    value: float
    unit: str
    known: bool
    std: float | None = None
    low: float | None = None
    high: float | None = None
    prior: float | None = None


class CheckEntry(Struct):
    """Effect that an identification looked for."""

    name: str
    finding: str
    there: bool
    effect: float | None = None
    where: str = ""
    counts: bool = True


class IdentificationDocument(Struct):
    """Document identification.json."""

    estimates: list[EstimateEntry]
    checks: list[CheckEntry]
    effect: float | None
    limit: float | None
    verdict: str
    reason: str
    notes: list[str]
    sources: dict[str, str]
    seed: int
    versions: dict[str, str]
    effect_on_error: float | None = None


class MonitoredMetric(Struct):
    """Metric of a contact, 0 if the mechanism file is right; None if the log does not show it."""

    value: float | None
    predicted_std: float | None
    z: float | None  # (value - predicted value) / predicted_std


class MonitoredContact(Struct):
    """Contact of later logs."""

    contact: int
    log: str
    state: str
    figures: dict[str, MonitoredMetric]


class MonitoringDocument(Struct):
    """Document of `jaxhil monitor --json`."""

    mechanism: str  # path of a file, or name of a built-in one
    mechanism_sha256: str | None
    state: str
    reason: str
    contacts: list[MonitoredContact]
    notes: list[str]
    sources: dict[str, str]
    versions: dict[str, str]
    since: int | None = None  # number of the contact at which a change likely began, from 1


class MetricEntry(Struct):
    """Metric of a compensator, with its interval if it has one."""

    value: float | None = None
    low: float | None = None
    high: float | None = None


class ComparedCompensator(Struct):
    """Metrics of a compensator by the name of its gains, then by the metric's name."""

    law: str
    figures: dict[str, dict[str, MetricEntry]]


class ComparedMechanism(Struct):
    """Metrics of all compensators for one mechanism."""

    mechanism: str
    laws: list[ComparedCompensator]


class ComparisonDocument(Struct):
    """Document compare.json."""

    limit: float | None
    seed: int
    scenarios: int
    judged: int
    tuned: bool
    mechanisms: list[ComparedMechanism]


class AxisOfMap(Struct):
    """Axis of map.json."""

    key: str
    unit: str
    nominal: float
    values: list[float]


class Theory(Struct):
    """Closed forms at every point of a map."""

    series: list[list[float | None]] | None = None
    characteristic_root: list[list[float | None]] | None = None
    delay_over_critical: list[list[float | None]] | None = None
    none_because: str | None = None


class RadiusOfMap(Struct):
    """Spectral radius over its own grid."""

    x: list[float] | None = None
    y: list[float] | None = None
    values: list[list[float]] | None = None
    none_because: str | None = None


class GrowthOfMap(Struct):
    """Growth of a lasting contact at the nominal point."""

    spectral_radius: float
    per_second: float
    frequency: float
    by_gain: dict[str, float]
    per_half_oscillation: float | None = None


class MarginOfMap(Struct):
    """Ends of a range; None if the map ends first."""

    low: float | None = None
    high: float | None = None


class MarginsOfMap(Struct):
    """Margins by axis, "x" and "y"; None if the nominal point itself exceeds the limit."""

    error: dict[str, MarginOfMap] | None = None
    contact: dict[str, MarginOfMap] | None = None
    spectral_radius: dict[str, MarginOfMap] | None = None


class NominalOfMap(Struct):
    """Results at the nominal point."""

    margins: MarginsOfMap
    restitution: float | None = None
    error: float | None = None
    peak_force_ratio: float | None = None
    duration_ratio: float | None = None
    growth: GrowthOfMap | None = None


class MapDocument(Struct):
    """Document map.json."""

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
