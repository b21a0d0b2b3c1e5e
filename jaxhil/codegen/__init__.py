"""C99 generator: reads the rig's Python and prints C that computes the same bits.

`Program` lowers functions, methods and classes of Python (see `subset` for what it understands) and returns
declarations and definitions in C. Everything outside the subset is refused with file, line and what to write
instead.
"""

from .program import Output, Program
from .subset import SubsetError

__all__ = ["Output", "Program", "SubsetError"]
