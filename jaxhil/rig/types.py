"""Annotated number types of the rig's code; the C99 generator (`jaxhil.codegen`) reads the annotations."""

from collections.abc import Mapping
from typing import Annotated

Positive = Annotated[float, "> 0"]
NonNegative = Annotated[float, ">= 0"]
Count = Annotated[int, ">= 0"]
Index = Annotated[int, "index"]  # index into a list; Python keeps it in range, as C has no check
Bits = Annotated[int, "uint32_t"]
SmallInt = Annotated[int, "int"]
Limits = Annotated[Mapping[str, float], "limits"]  # limit names and values
Gains = Annotated[Mapping[str, float], "gains"]  # gain names and values
