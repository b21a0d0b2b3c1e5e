"""What `tuning.tune` returns: tuned gains, and points of a front that trade the error for something else."""

import functools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning.front_door import arguments, tune_verdict
from tuning.front_door.tune_verdict import CommandFigures

if TYPE_CHECKING:
    from jaxhil.simulation.plausibility import Meaning
    from tuning.gains.pareto import Front, Point
    from tuning.gains.tune import ErrorFigures, TuneResult

# Names in files that stand for those that the objective uses.
IN_FILES = {"transparency_weight": "honesty_weight"}


@dataclass(frozen=True)
class TunedGains:
    """What `tune` returns of one mechanism.

    found: all that tuning found (`tuning.gains.tune.TuneResult`).
    mechanism_sha256: SHA-256 of the mechanism's file.
    limit: the rms error [1] that is still good.
    pareto: the front of gains that trade the error for something else, if one was asked for.
    """

    found: "TuneResult"
    mechanism_sha256: str
    limit: float
    pareto: "tuple[TradedGains, ...]" = ()

    @property
    def mechanism(self) -> AnyMechanism:
        """What was tuned for."""
        return self.found.mechanism

    @property
    def compensator(self) -> str:
        """The name of the law that was tuned."""
        return self.found.compensator

    @property
    def gains(self) -> dict[str, float]:
        """The tuned gains by name [SI units], those that are not tuned among them."""
        return self.found.gains

    @property
    def literature(self) -> dict[str, float]:
        """The gains that the literature's rules give, or those of the setting, by name [SI units]."""
        return self.found.literature

    @property
    def figures(self) -> "dict[str, ErrorFigures]":
        """Errors on fresh scenarios "before" (no compensation), with the "literature"'s gains and with the
        "tuned" ones: each has rms, p99, max [1] and more."""
        return self.found.figures

    @property
    def parts(self) -> "dict[str, dict[str, ErrorFigures]]":
        """In six axes, the same of "energy_error" and "twist_error", each by itself; else nothing."""
        from tuning.gains.tune import figures_of_parts

        return figures_of_parts(self.found)

    @property
    def verdict(self) -> str:
        """ "good" if every contact ended with the tuned gains, their rms error is within the limit, and at
        most 1 % of the real contacts are harder, shorter or longer than the ideal contact allows, with the
        sensors' noise and without, else "bad"."""
        return "good" if tune_verdict.is_good(self.found, self.limit) else "bad"

    @property
    def without_noise(self) -> "ErrorFigures | None":
        """Errors of the tuned gains on the same scenarios without the sensors' noise; None where the
        mechanism has none."""
        return self.found.without_noise

    @functools.cached_property
    def command(self) -> CommandFigures:
        """What the tuned gains do to the force command: `peak_p99`, the 99th percentile of its peak over the
        ideal contact's peak force, and `noise_amplification` [1]."""
        return tune_verdict.command_figures(self.found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each figure of `command` beyond its bound."""
        return tune_verdict.command_warnings(self.found, self.command)

    @functools.cached_property
    def meaning(self) -> "Meaning | None":
        """What the mechanism means: mass, contacts in space, rates; `warnings` of what cannot be meant. In
        six axes None: a run of `jaxhil.simulate` has it."""
        from jaxhil.simulation import plausibility

        if isinstance(self.mechanism, SixAxisMechanism):
            return None
        return plausibility.meaning(self.mechanism)

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """The content of the gain file."""
        from tuning.gain_file import build_document, envelope_in_space, validity_envelope
        from tuning.transparency.pushes import PUSHES

        found = self.found
        if isinstance(found.mechanism, SixAxisMechanism):
            envelope = envelope_in_space(found.scenarios, found.outcomes["tuned"])
        else:
            envelope = validity_envelope(found.mechanism, found.scenarios)
        return build_document(
            found.compensator,
            found.gains,
            found.mechanism,
            self.mechanism_sha256,
            envelope,
            {
                "nominal": found.nominal,
                "robust": found.figures,
                "tuned_intervals": found.intervals.plain() if found.intervals else None,
                **self.parts,
                "without_noise": found.without_noise,
                "command": self.command,
                "warnings": self.warnings,
                **({"honesty": found.transparency, "transparency": PUSHES} if found.transparency else {}),
            },
            found.settings.seed,
            found.timings,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file. Raises `InputError` when it cannot be written."""
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.folder("path", path), self.document)


@dataclass(frozen=True)
class TradedGains:
    """One point of a front.

    tuned: what was tuned without a trade-off.
    front: the whole front (`tuning.gains.pareto.Front`).
    point: this point of it (`tuning.gains.pareto.Point`).
    """

    tuned: TunedGains
    front: "Front"
    point: "Point"

    @property
    def gains(self) -> dict[str, float]:
        """By name [SI units]."""
        return self.point.gains

    @property
    def figures(self) -> "ErrorFigures":
        """Errors on fresh scenarios."""
        return self.point.figures

    @property
    def traded(self) -> dict[str, Any]:
        """The weight of what is traded, its cost, the error [1], and whether no other point beats it."""
        axis = self.front.axis
        return {
            IN_FILES.get(axis.weight, axis.weight): self.point.weight,
            axis.cost: self.point.cost,
            "error": self.point.error,
            "on_front": self.point.on_front,
        }

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """The content of the gain file."""
        from tuning.gain_file import build_document, validity_envelope

        found, point = self.tuned.found, self.point
        mechanism: Any = found.mechanism
        figures: dict[str, Any] = {
            "nominal": {**found.nominal, "tuned": point.nominal},
            "robust": {**found.figures, "tuned": point.figures},
            "tuned_intervals": point.intervals.plain(),
        }
        if point.transparency is not None:
            figures["honesty"] = {**found.transparency, "tuned": point.transparency}
        return build_document(
            found.compensator,
            point.gains,
            found.mechanism,
            self.tuned.mechanism_sha256,
            validity_envelope(mechanism, found.scenarios),
            {**figures, "pareto": self.traded},
            found.settings.seed,
            {},
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file. Raises `InputError` when it cannot be written."""
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.folder("path", path), self.document)
