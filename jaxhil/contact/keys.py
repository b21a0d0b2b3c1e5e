"""Keys of the table `[contact]` that only some contact laws have: description, unit, range and default."""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

from msgspec import Meta, field

__all__ = ["DEPTHS", "EXPONENT", "REFERENCE_DEPTH", "ContactKey", "key_metadata"]

MAX_DEPTHS = 20  # limit on the number of entries of the key `depths`


def key_metadata(meaning: str, unit: str | None = None, **limits: Any) -> Meta:
    """Return the msgspec metadata of a key: its description, unit and allowed values.

    Args:
        meaning: description of the key, one line.
        unit: unit of a number ("1" if dimensionless); None for other types.
        limits: allowed values as keyword arguments with msgspec's names, such as ``ge=0.0``. With
            ``infinite=True``, infinity is allowed too.
    """
    unit_entry = {} if unit is None else {"unit": unit}
    extra = {"infinite": limits.pop("infinite", False), **unit_entry}
    return Meta(description=meaning, extra=extra, extra_json_schema=unit_entry, **limits)


class ContactKey(NamedTuple):
    """Key of `[contact]` that only some contact laws have.

    The key is a flag if `default` is a bool, a list if `default` is a list, and a number otherwise.
    """

    name: str
    meaning: str  # description; "{laws}" stands for the names of the laws that have the key
    unit: str | None = None  # unit of the number or of the list's entries; None for a flag
    limits: Mapping[str, float] = {}  # allowed values of the number or list entries, by msgspec's names
    default: Any = None  # None: laws that have the key require it
    neutral: float = 0.0  # value in `ContactParameters` if the file has no value
    name_in_six_axes: str = ""  # name in six-axis files, if it differs from `name`
    meaning_in_six_axes: str = ""  # description in six-axis files, if `name_in_six_axes` is not empty

    def in_six_axes(self) -> "ContactKey":
        """Return the key with its name and description in six-axis files."""
        if not self.name_in_six_axes:
            return self
        return self._replace(name=self.name_in_six_axes, meaning=self.meaning_in_six_axes)

    def struct_field(self, laws: str) -> tuple[str, Any, Any]:
        """Return the field for `msgspec.defstruct`: name, type and default.

        The text `laws` replaces "{laws}" in the description.
        """
        meaning = self.meaning.format(laws=laws)
        if isinstance(self.default, bool):
            return self.name, Annotated[bool, key_metadata(meaning)], self.default
        if isinstance(self.default, list):
            entry = Annotated[float, key_metadata(meaning.split(",")[0], self.unit, **self.limits)]
            kind = Annotated[list[entry], Meta(max_length=MAX_DEPTHS, description=meaning)]
            return self.name, kind, field(default_factory=list)
        number: Any = Annotated[float, key_metadata(meaning, self.unit, **self.limits)]
        return self.name, number | None if self.default is None else number, self.default


EXPONENT = ContactKey("exponent", "exponent of the depth, for {laws}", "1", {"ge": 1.0}, default=1.5)
DEPTHS = ContactKey("depths", "depths where the slope changes, for {laws}", "m", {"gt": 0.0}, default=[])
REFERENCE_DEPTH = ContactKey(
    "reference_depth",
    "depth where hardening has four times its initial slope, and where depth_damped has its damping",
    "m",
    {"gt": 0.0},
    neutral=1.0,
)
