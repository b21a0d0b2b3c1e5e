"""C99 generator: translates the rig's Python code to C that computes the same bits.

`CProgram` lowers functions, methods and classes of Python and returns declarations and definitions in C.
`subset` describes the subset of Python. Constructs outside it raise `SubsetError` with file, line and what to
write instead.
"""

from .program import CProgram, GeneratedCode
from .subset import SubsetError

__all__ = ["CProgram", "GeneratedCode", "SubsetError"]
