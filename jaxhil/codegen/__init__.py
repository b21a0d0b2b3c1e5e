"""C99 generator: translates the rig's Python code to C code with bit-identical results.

`CProgram` lowers (translates to C) functions, methods and classes of Python, and returns declarations and
definitions in C. `subset` describes the supported subset of Python. Every other construct raises
`SubsetError`; the message names file, line and a supported alternative.
"""

from .program import CProgram, GeneratedCode
from .subset import SubsetError

__all__ = ["CProgram", "GeneratedCode", "SubsetError"]
