"""Results of `tuning.tune`: tuned gains, and points of a Pareto front."""

import functools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning.api import arguments, tune_verdict
from tuning.api.tune_verdict import CommandMetrics

if TYPE_CHECKING:
    from jaxhil.simulation.plausibility import MechanismSummary
    from tuning.gains.pareto import ParetoFront, ParetoPoint
    from tuning.gains.tune import ErrorMetrics, TuneResult

# Names in files of the objective's weights, where they differ.
NAMES_IN_FILES = {"transparency_weight": "honesty_weight"}


@dataclass(frozen=True)
class TunedGains:
    """Result of `tune` for one mechanism.

    Attributes:
        found: all results of the tuning (`tuning.gains.tune.TuneResult`).
        mechanism_sha256: SHA-256 of the mechanism's file.
        limit: largest rms error with a good verdict [1].
        pareto: points of the Pareto front, if one was requested.
    """

    found: "TuneResult"
    mechanism_sha256: str
    limit: float
    pareto: "tuple[TradedGains, ...]" = ()

    @property
    def mechanism(self) -> AnyMechanism:
        """Return the mechanism that the gains were tuned for."""
        return self.found.mechanism

    @property
    def compensator(self) -> str:
        """Return the name of the tuned compensator."""
        return self.found.compensator

    @property
    def gains(self) -> dict[str, float]:
        """Return all gains by name [SI units], including those that are not tuned."""
        return self.found.gains

    @property
    def literature(self) -> dict[str, float]:
        """Return the gains of the literature's rules, or of the setting, by name [SI units]."""
        return self.found.literature

    @property
    def figures(self) -> "dict[str, ErrorMetrics]":
        """Return the errors on fresh scenarios by gains.

        The keys are "before" (no compensation), "literature" and "tuned"; each value has rms, p99, max [1]
        and more.
        """
        return self.found.figures

    @property
    def parts(self) -> "dict[str, dict[str, ErrorMetrics]]":
        """Return "energy_error" and "twist_error" of six axes, each like `figures`; empty for one axis."""
        from tuning.gains.tune import compute_metrics_by_error

        return compute_metrics_by_error(self.found)

    @property
    def verdict(self) -> str:
        """Return the verdict, "good" or "bad".

        It is "good" if, with and without sensor noise, every contact ended, the rms error is within the
        limit, and at most 1 % of the real contacts are harder, shorter or longer than the ideal contact
        allows.
        """
        return "good" if tune_verdict.is_good(self.found, self.limit) else "bad"

    @property
    def without_noise(self) -> "ErrorMetrics | None":
        """Return the errors on the same scenarios without sensor noise; None without noise in the file."""
        return self.found.without_noise

    @functools.cached_property
    def command(self) -> CommandMetrics:
        """Return the metrics of the force command with the tuned gains.

        `peak_p99` is the 99th percentile of its peak over the ideal contact's peak force [1], and
        `noise_amplification` the amplification of the sensor noise [1].
        """
        return tune_verdict.command_metrics(self.found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence for each metric of `command` beyond its bound."""
        return tune_verdict.command_warnings(self.found, self.command)

    @functools.cached_property
    def meaning(self) -> "MechanismSummary | None":
        """Return a summary of the mechanism: mass, ideal contacts, rates, warnings of implausible values.

        In six axes this is None; a result of `jaxhil.simulate` has the summary.
        """
        from jaxhil.simulation import plausibility

        if isinstance(self.mechanism, SixAxisMechanism):
            return None
        return plausibility.summarise_mechanism(self.mechanism)

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """Return the content of the gain file."""
        from tuning.gain_file import build_document, six_axis_validity_envelope, validity_envelope
        from tuning.transparency.pushes import PUSH_DEFINITION

        result = self.found
        if isinstance(result.mechanism, SixAxisMechanism):
            envelope = six_axis_validity_envelope(result.scenarios, result.outcomes["tuned"])
        else:
            envelope = validity_envelope(result.mechanism, result.scenarios)
        return build_document(
            result.compensator,
            result.gains,
            result.mechanism,
            self.mechanism_sha256,
            envelope,
            {
                "nominal": result.nominal,
                "robust": result.figures,
                "tuned_intervals": result.intervals.plain() if result.intervals else None,
                **self.parts,
                "without_noise": result.without_noise,
                "command": self.command,
                "warnings": self.warnings,
                **(
                    {"honesty": result.transparency, "transparency": PUSH_DEFINITION}
                    if result.transparency
                    else {}
                ),
            },
            result.settings.seed,
            result.timings,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file. Raise `InputError` if it cannot be written."""
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.check_path("path", path), self.document)


@dataclass(frozen=True)
class TradedGains:
    """Point of a Pareto front.

    Attributes:
        tuned: gains tuned without a trade-off.
        front: the whole front (`tuning.gains.pareto.Front`).
        point: this point of the front (`tuning.gains.pareto.Point`).
    """

    tuned: TunedGains
    front: "ParetoFront"
    point: "ParetoPoint"

    @property
    def gains(self) -> dict[str, float]:
        """Return the gains of the point by name [SI units]."""
        return self.point.gains

    @property
    def figures(self) -> "ErrorMetrics":
        """Return the errors on fresh scenarios."""
        return self.point.figures

    @property
    def traded(self) -> dict[str, Any]:
        """Return the weight, the cost, the error [1], and whether the point is on the front."""
        axis = self.front.axis
        return {
            NAMES_IN_FILES.get(axis.weight, axis.weight): self.point.weight,
            axis.cost: self.point.cost,
            "error": self.point.error,
            "on_front": self.point.on_front,
        }

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """Return the content of the gain file."""
        from tuning.gain_file import build_document, validity_envelope

        result, point = self.tuned.found, self.point
        mechanism: Any = result.mechanism
        figures: dict[str, Any] = {
            "nominal": {**result.nominal, "tuned": point.nominal},
            "robust": {**result.figures, "tuned": point.figures},
            "tuned_intervals": point.intervals.plain(),
        }
        if point.transparency is not None:
            figures["honesty"] = {**result.transparency, "tuned": point.transparency}
        return build_document(
            result.compensator,
            point.gains,
            result.mechanism,
            self.tuned.mechanism_sha256,
            validity_envelope(mechanism, result.scenarios),
            {**figures, "pareto": self.traded},
            result.settings.seed,
            {},
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file. Raise `InputError` if it cannot be written."""
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.check_path("path", path), self.document)
