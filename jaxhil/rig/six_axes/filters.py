"""Lead filters for the six channels of a wrench."""

from jaxhil.rig.six_axes.vectors import AXES, Vector


class WrenchLead:
    """Six lead filters (1 + T_1 s)/(1 + T_2 s), T_1 = lead + lag, T_2 = lag, discretised by Tustin's rule.

    Each channel has the filter `jaxhil.rig.filters.LeadFilter` with its own lead time.

    Args:
        leads: lead time of each channel [s].
        lag: lag time T_2 of all channels [s].
        period: control period [s].
    """

    __slots__ = ("_denominator", "_input", "_of_input", "_of_output", "_of_previous", "_output")
    _input: Vector
    _output: Vector

    def __init__(self, leads: Vector, lag: float, period: float) -> None:
        self._of_output = 2.0 * lag - period
        self._of_input = [2.0 * (lead + lag) + period for lead in leads]
        self._of_previous = [2.0 * (lead + lag) - period for lead in leads]
        self._denominator = 2.0 * lag + period
        self.reset()

    def reset(self) -> None:
        """Set past inputs and outputs to 0."""
        self._input = [0.0] * AXES
        self._output = [0.0] * AXES

    def step(self, wrench: Vector) -> Vector:
        """Return the filtered wrench."""
        output = [
            (self._of_output * last + now * value - before * previous) / self._denominator
            for last, now, value, before, previous in zip(
                self._output, self._of_input, wrench, self._of_previous, self._input, strict=True
            )
        ]
        self._input = list(wrench)
        self._output = output
        return output
