"""Settings of a tuning run: numbers of scenarios, starts and steps, and the objective."""

from dataclasses import dataclass

from tuning.gains.objective import RMS_OBJECTIVE, Objective


@dataclass(frozen=True)
class TuneSettings:
    """Settings of a tuning run, the same for all mechanisms."""

    # number of training scenarios; None: 32, or 128 with sensor noise (`tuning.gains.tasks`)
    scenarios: int | None = None
    # number of starts of the solver in a batch (`tuning.gains.multistart`)
    starts: int = 4
    # largest number of solver steps from each start, or of generations of a search without derivatives
    steps: int = 25
    validation: int = 511  # number of fresh scenarios that evaluate the tuned gains
    seed: int = 0  # seed of scenarios and starts
    objective: Objective = RMS_OBJECTIVE  # objective to minimise
    polish: int = 160  # evaluations of the objective by the final derivative-free search, per gain
    # whether to compare the tuned gains with a global search over the gains' whole ranges
    global_search: bool = False
    scanned: int = 256  # number of points in a scan; the best points become starts
    # name of one of the compensator's fixed sets of gains, which is evaluated without tuning; None: tune
    setting: str | None = None
    # whether to search for the quietest gains within the objective's limit if a sensor has noise
    quiet: bool = False
    # whether a search without derivatives rejects gains whose error exceeds that of the literature's gains
    bounded: bool = False
    # whether to evaluate transparency even if its weight in the objective is 0
    evaluate_transparency: bool = False

    @property
    def probed(self) -> bool:
        """Return whether every scenario includes transparency probes (`tuning.transparency.probes`)."""
        return self.evaluate_transparency or self.objective.transparency_weight > 0
