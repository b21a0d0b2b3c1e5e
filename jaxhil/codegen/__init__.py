"""C99 generator: translates the rig's Python code to C that computes the same bits.

`Program` lowers functions, methods and classes of Python and returns declarations and definitions in C.
`subset` describes the subset of Python. Constructs outside it raise `SubsetError` with file, line and what to
write instead.
"""

from .program import Output, Program
from .subset import SubsetError

__all__ = ["Output", "Program", "SubsetError"]
