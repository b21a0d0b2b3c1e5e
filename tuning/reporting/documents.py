"""The documents that commands write, as far as a report shows them: types that no foreign file fits."""

from msgspec import Struct


class Probability(Struct):
    """A probability with an interval of 95 %."""

    value: float
    low: float
    high: float
    method: str = ""


class Quantile(Struct):
    """Of the worst |e - e*| of a scenario; None where it is infinite."""

    order: float
    value: float | None = None
    low: float | None = None
    high: float | None = None


class WorstScenario(Struct):
    """One of a sweep's worst."""

    index: int
    outcome: str
    worst_error: float | None = None
    worst_contact: int | None = None
    inputs: dict[str, float | None] = {}


class InputShares(Struct):
    """Sobol indices of an input, with ends of their intervals."""

    input: str
    first_order: float | None = None
    first_order_low: float | None = None
    first_order_high: float | None = None
    total: float | None = None
    total_low: float | None = None
    total_high: float | None = None


class Drivers(Struct):
    """What drives the error."""

    inputs: list[InputShares]
    cap: float
    evaluations: int
    capped: int


class Rare(Struct):
    """Subset simulation."""

    limit: float
    probability: float
    low: float
    high: float
    evaluations: int
    coefficient_of_variation: float | None = None
    spread_beyond_formula: bool = False


class SweepVerdict(Struct):
    """verdict.json of a sweep's store."""

    sweep_sha256: str
    gains_sha256: str
    mechanism: str
    compensator: str
    scenarios: int
    seed: int
    sampling: str
    precision: str
    failed: int
    failure_probability: Probability
    error_quantiles: list[Quantile]
    outcomes: dict[str, int]
    worst: list[WorstScenario]
    verdict: str
    limit: float | None = None
    until_width: float | None = None
    acceptable: float | None = None
    drivers: Drivers | None = None
    rare: Rare | None = None


class Estimate(Struct):
    """A number that was identified, or known beforehand."""

    key: str
    value: float
    unit: str
    known: bool
    std: float | None = None
    low: float | None = None
    high: float | None = None
    prior: float | None = None


class Check(Struct):
    """What an identification looked for."""

    name: str
    finding: str
    there: bool
    effect: float | None = None
    where: str = ""
    counts: bool = True


class Identification(Struct):
    """identification.json."""

    estimates: list[Estimate]
    checks: list[Check]
    effect: float | None
    limit: float | None
    verdict: str
    reason: str
    notes: list[str]
    sources: dict[str, str]
    seed: int
    versions: dict[str, str]
    effect_on_error: float | None = None


class MonitoredFigure(Struct):
    """Of a contact, 0 where the mechanism file is right; None where the log does not tell."""

    value: float | None
    predicted_std: float | None
    z: float | None  # value less the predicted one, over that


class MonitoredContact(Struct):
    """A contact of later logs."""

    contact: int
    log: str
    state: str
    figures: dict[str, MonitoredFigure]


class Monitoring(Struct):
    """What `jaxhil monitor --json` prints."""

    mechanism: str  # path of its file, or the name of a built-in one
    mechanism_sha256: str | None
    state: str
    reason: str
    contacts: list[MonitoredContact]
    notes: list[str]
    sources: dict[str, str]
    versions: dict[str, str]
    since: int | None = None  # contact with which a change likely began, from 1


class Figure(Struct):
    """A figure of a law, with its interval where it has one."""

    value: float | None = None
    low: float | None = None
    high: float | None = None


class LawOfComparison(Struct):
    """A law's figures, by the name of its gains and the figure's."""

    law: str
    figures: dict[str, dict[str, Figure]]


class MechanismOfComparison(Struct):
    """All laws on one mechanism."""

    mechanism: str
    laws: list[LawOfComparison]


class Comparison(Struct):
    """compare.json."""

    limit: float | None
    seed: int
    scenarios: int
    judged: int
    tuned: bool
    mechanisms: list[MechanismOfComparison]


class AxisOfMap(Struct):
    """An axis of map.json."""

    key: str
    unit: str
    nominal: float
    values: list[float]


class Theory(Struct):
    """What theory says at every point of a map."""

    series: list[list[float | None]] | None = None
    characteristic_root: list[list[float | None]] | None = None
    delay_over_critical: list[list[float | None]] | None = None
    none_because: str | None = None


class RadiusOfMap(Struct):
    """The spectral radius over its own grid."""

    x: list[float] | None = None
    y: list[float] | None = None
    values: list[list[float]] | None = None
    none_because: str | None = None


class GrowthOfMap(Struct):
    """Of a contact that lasts, at the nominal point."""

    spectral_radius: float
    per_second: float
    frequency: float
    by_gain: dict[str, float]
    per_half_oscillation: float | None = None


class MarginOfMap(Struct):
    """Ends of a range; None where the map ends first."""

    low: float | None = None
    high: float | None = None


class MarginsOfMap(Struct):
    """Along x and y by their names; None where the nominal point itself is beyond."""

    error: dict[str, MarginOfMap] | None = None
    contact: dict[str, MarginOfMap] | None = None
    spectral_radius: dict[str, MarginOfMap] | None = None


class NominalOfMap(Struct):
    """The nominal point."""

    margins: MarginsOfMap
    restitution: float | None = None
    error: float | None = None
    peak_force_ratio: float | None = None
    duration_ratio: float | None = None
    growth: GrowthOfMap | None = None


class MapDocument(Struct):
    """map.json."""

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
