"""Keys of a mechanism file's `[contact]` that belong to some contact laws: meaning, unit, range, default."""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

from msgspec import Meta, field

__all__ = ["DEPTHS", "EXPONENT", "REFERENCE_DEPTH", "Key", "says"]

MAX_DEPTHS = 20  # depths at which a piecewise-linear law changes its slope


def says(meaning: str, unit: str | None = None, **limits: Any) -> Meta:
    """Return the metadata of a key's type: a line of meaning, a number's unit ("1" if it has none), and the
    allowed values."""
    stated = {} if unit is None else {"unit": unit}
    extra = {"infinite": limits.pop("infinite", False), **stated}
    return Meta(description=meaning, extra=extra, extra_json_schema=stated, **limits)


class Key(NamedTuple):
    """One key of a contact law: a number; a flag, if its default is a bool; a list, if its default is one."""

    name: str
    meaning: str  # "{laws}" stands for the names of the laws that have the key
    unit: str | None = None  # of the number or of the list's entries; None of a flag
    limits: Mapping[str, float] = {}  # of the number or of the list's entries, as msgspec calls them
    default: Any = None  # None: the laws that have the key need a value
    neutral: float = 0.0  # value in `ContactParameters` if the file has none
    name_in_six_axes: str = ""  # name and meaning in files of six axes, if they differ
    meaning_in_six_axes: str = ""

    def in_six_axes(self) -> "Key":
        """Return the key as files of six axes have it."""
        if not self.name_in_six_axes:
            return self
        return self._replace(name=self.name_in_six_axes, meaning=self.meaning_in_six_axes)

    def struct_field(self, laws: str) -> tuple[str, Any, Any]:
        """Return name, type and default for `msgspec.defstruct`; `laws` are those with the key, in words."""
        meaning = self.meaning.format(laws=laws)
        if isinstance(self.default, bool):
            return self.name, Annotated[bool, says(meaning)], self.default
        if isinstance(self.default, list):
            entry = Annotated[float, says(meaning.split(",")[0], self.unit, **self.limits)]
            kind = Annotated[list[entry], Meta(max_length=MAX_DEPTHS, description=meaning)]
            return self.name, kind, field(default_factory=list)
        number: Any = Annotated[float, says(meaning, self.unit, **self.limits)]
        return self.name, number | None if self.default is None else number, self.default


EXPONENT = Key("exponent", "of the depth, for {laws}", "1", {"ge": 1.0}, default=1.5)
DEPTHS = Key("depths", "where the slope changes, for {laws}", "m", {"gt": 0.0}, default=[])
REFERENCE_DEPTH = Key(
    "reference_depth",
    "at which hardening has four times its first slope, and depth_damped its damping",
    "m",
    {"gt": 0.0},
    neutral=1.0,
)
