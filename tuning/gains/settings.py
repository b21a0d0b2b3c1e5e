"""Settings of a tuning run: numbers of scenarios, starts and steps, and the objective."""

from dataclasses import dataclass

from tuning.gains.objective import RMS_OBJECTIVE, Objective


@dataclass(frozen=True)
class TuneSettings:
    """Settings of `tuning.gains.tune`, the same for all mechanisms of a run."""

    # number of training scenarios; None: 32, or 128 with sensor noise (`tuning.gains.tasks`)
    scenarios: int | None = None
    # starts of the solver in every batch (`tuning.gains.multistart`)
    starts: int = 4
    steps: int = 25  # largest number of solver steps from each start
    validation: int = 511  # number of fresh scenarios on which the gains are evaluated
    seed: int = 0  # seed of scenarios and starts
    objective: Objective = RMS_OBJECTIVE  # objective to minimise
    polish: int = 160  # evaluations of the final search without derivatives, per gain
    # whether to compare the tuned gains with those of a search of the gains' whole ranges
    global_search: bool = False
    scanned: int = 256  # points of a scan, the best of which become starts
    # name of a setting of the compensator's gains that is evaluated instead of tuning
    setting: str | None = None
    # whether to search for the quietest gains within the objective's limit if sensors are noisy
    quiet: bool = False
    # whether to evaluate transparency even if the objective does not weight it
    evaluate_transparency: bool = False

    @property
    def probed(self) -> bool:
        """Return whether every scenario has its transparency probes (`tuning.transparency.probes`)."""
        return self.evaluate_transparency or self.objective.transparency_weight > 0
