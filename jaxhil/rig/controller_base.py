"""Common part of the controllers for one axis and for six axes: faults, trips, clock and statuses."""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

from jaxhil.rig.clock import Clock
from jaxhil.rig.faults import EMERGENCY_STOP, Fault, fault_names
from jaxhil.rig.gain_document import read_gain_document
from jaxhil.rig.law_status import STATUS_NAMES, ContactCount, ContactRecord, contact_record
from jaxhil.rig.types import Bits, Positive, SmallInt


class ControllerBase:
    """Base of the controllers: faults, trips and statuses; a subclass adds the signals of its axes.

    Attributes:
        faults: bits of the present tick's faults.
        seen: bits of all faults since `reset`.
        cause: bits of the faults that tripped the controller; 0 if it is not tripped.
    """

    __slots__ = ()
    fault_table: ClassVar[Sequence[Fault]]
    _check: ClassVar[Callable[..., Any]]  # checks a gain document and returns its content
    cause: Bits
    faults: Bits
    seen: Bits
    _clock: Clock
    _detail: str
    _law: Any
    _period: Positive
    _stopped: bool
    _watchdog: Any

    def __init__(self, gain_file: Any, source: str = "gain document") -> None:
        raise NotImplementedError

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """Create a controller from a gain file.

        Args:
            path: path of the gain file.

        Raises:
            GainFileError: if the file is invalid.
        """
        source = os.fspath(path)
        return cls(cls._check(read_gain_document(source), source), source)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Create a controller from the content of a gain file.

        Args:
            document: content of a gain file.

        Raises:
            GainFileError: if the document is invalid.

        Example:
            >>> from jaxhil.rig import Controller, digest
            >>> document = {
            ...     "schema": "jaxhil/gains/1",
            ...     "compensator": "none",
            ...     "gains": {},
            ...     "control_period": 0.001,
            ...     "mechanism": {"rig": {"control_period": 0.001}, "contact": {}},
            ... }
            >>> controller = Controller.from_dict(document | {"sha256": digest(document)})
            >>> controller.step(10.0, 0.001, -0.005, 0.0012)
            10.0
        """
        return cls(cls._check(document))

    @property
    def control_period(self) -> float:
        """Return the control period [s] for which the gains are valid."""
        return self._period

    @property
    def tripped(self) -> bool:
        """Return whether a fault has tripped the controller since the last `reset`."""
        return self.cause != 0

    @property
    def status(self) -> str:
        """Return "ok", or "tripped: " and the names of the causing faults."""
        if not self.cause:
            return "ok"
        names = ", ".join(fault_names(self.cause, self.fault_table))
        return f"tripped: {names}" + (f" ({self._detail})" if self._detail else "")

    @property
    def missed_ticks(self) -> int:
        """Return the number of missed ticks since `reset`, from the times passed to `step`."""
        return self._clock.missed

    @property
    def late_ticks(self) -> int:
        """Return the number of late ticks since `reset`, from the times passed to `step`."""
        return self._clock.late

    @property
    def law_status(self) -> str:
        """Return the compensator's status at the last command, a name in `law_status.STATUSES`."""
        return STATUS_NAMES[self._status()]

    def _status(self) -> SmallInt:
        """Return the number of the compensator's status at the last command."""
        return self._law.status

    @property
    def last_contact(self) -> ContactRecord:
        """Return the record of the last contact that the watchdog audited, with the compensator's status.

        Before the first audit, the contact number in the record is 0. `reset` keeps the record.
        """
        return contact_record(self._last_count())

    def _last_count(self) -> ContactCount:
        """Return the counts of ticks with each compensator status in the last audited contact."""
        return self._watchdog.record

    def emergency_stop(self, active: bool) -> None:
        """Set the state of the rig's emergency stop; an active stop trips the controller.

        Call this method with True when the stop is pressed. The force command ramps to 0 and the position
        command comes to rest; then `at_rest` is True and the drives may be switched off. Call it with False
        when the stop is released; before this call, `reset` has no effect. The trip stays latched until
        `reset`.

        Args:
            active: whether the stop is active.
        """
        self._stopped = bool(active)
        if active:
            self._fail(EMERGENCY_STOP, "")

    def _fail(self, cause: int, detail: str) -> None:
        """Trip the controller with the fault bits `cause`; the status shows the text `detail`."""
        # Keep the first cause, because later faults may be its consequences.
        if not self.cause:
            self.cause = cause
            self._detail = detail
        self.faults |= cause
        self.seen |= self.faults
