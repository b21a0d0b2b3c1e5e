"""Types of the rig's numbers, with properties that the C99 generator (`jaxhil.codegen`) reads."""

from collections.abc import Mapping
from typing import Annotated

Positive = Annotated[float, "> 0"]
NonNegative = Annotated[float, ">= 0"]
Count = Annotated[int, ">= 0"]
Index = Annotated[int, "index"]  # into a list; Python code assures that it is in range: C does not test it
Bits = Annotated[int, "uint32_t"]
SmallInt = Annotated[int, "int"]
Limits = Annotated[Mapping[str, float], "limits"]  # by name
Gains = Annotated[Mapping[str, float], "gains"]  # by name
