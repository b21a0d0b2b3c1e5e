"""Types of the rig's numbers: what the C99 generator (`jaxhil.codegen`) knows of them beside the kind."""

from collections.abc import Mapping
from typing import Annotated

Positive = Annotated[float, "> 0"]
NonNegative = Annotated[float, ">= 0"]
Count = Annotated[int, ">= 0"]
Index = Annotated[int, "index"]  # into a list of its class, which keeps it within: C does not test it
Bits = Annotated[int, "uint32_t"]
SmallInt = Annotated[int, "int"]
Limits = Annotated[Mapping[str, float], "limits"]  # by name
Gains = Annotated[Mapping[str, float], "gains"]  # by name
