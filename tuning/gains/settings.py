"""What a tuning run is asked to do: how many scenarios, starts and steps, and what to minimise."""

from dataclasses import dataclass

from tuning.gains.objective import RMS, Objective


@dataclass(frozen=True)
class TuneSettings:
    """Settings of `tuning.gains.tune`, the same for all mechanisms of a run."""

    # how many to tune on; None: 32, or 128 with sensor noise (`tuning.gains.tasks`)
    scenarios: int | None = None
    # points that the solver starts from, in every batch of starts (`tuning.gains.multistart`)
    starts: int = 4
    steps: int = 25  # most solver steps from each start
    validation: int = 511  # fresh scenarios to judge the gains on
    seed: int = 0  # of scenarios and starts
    objective: Objective = RMS  # what to minimise
    polish: int = 160  # evaluations without derivatives at the end, for each gain
    # whether to search the gains' whole ranges as well, and say how much better they can be
    global_search: bool = False
    scanned: int = 256  # points of a scan, the best of which become starts
    # name of the compensator's gains that are judged as they are, in the place of tuning
    setting: str | None = None
    # whether the quietest gains within the objective's limit are wanted, where sensors are noisy
    quiet: bool = False
    # whether to judge transparency even where the objective does not weigh it
    judge_transparency: bool = False

    @property
    def probed(self) -> bool:
        """Whether every scenario comes with its transparency probes (`tuning.transparency.probes`)."""
        return self.judge_transparency or self.objective.transparency_weight > 0
