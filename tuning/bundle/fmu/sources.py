"""C sources of an FMU: its variables as generated tables, and the files that all FMUs share."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from tuning.bundle.c99_tables import format_double
from tuning.bundle.fmu.variables import Variable

FOLDER = Path(__file__).parent
FMI_FILES = {2: ("fmi2.c",), 3: ("fmi3.c", "fmi3_missing.c")}
VARIABLE_TYPES = {
    "real": "FMU_REAL",
    "integer": "FMU_INTEGER",
    "boolean": "FMU_BOOLEAN",
    "string": "FMU_STRING",
}
CAUSALITIES = {
    "independent": "FMU_TIME",
    "parameter": "FMU_PARAMETER",
    "input": "FMU_INPUT",
    "output": "FMU_OUTPUT",
}

_HEADER_TEMPLATE = """\
/* Variables of the FMU. The position of a variable is its value reference. */
#ifndef FMU_VARIABLES_H
#define FMU_VARIABLES_H

#define FMU_TOKEN "{token}"
#define FMU_PERIOD {period} /* control period [s] */
{constants}
typedef enum {{ FMU_REAL, FMU_INTEGER, FMU_BOOLEAN, FMU_STRING }} fmu_type;
typedef enum {{ FMU_TIME, FMU_PARAMETER, FMU_INPUT, FMU_OUTPUT }} fmu_causality;

typedef struct {{
    const char *name;
    fmu_type type;
    fmu_causality causality;
    double start;
    double lowest;
    double highest;
}} fmu_variable;

enum {{
{references},
    V_COUNT
}};

extern const fmu_variable fmu_variables[V_COUNT];

#endif
"""

_TABLE_TEMPLATE = """\
/* See fmu_variables.h. */
#include "fmu_variables.h"

#include <math.h>

const fmu_variable fmu_variables[V_COUNT] = {{
{rows}
}};
"""


def variable_files(
    variables: Sequence[Variable], token: str, period: float, constants: Mapping[str, int | str]
) -> dict[str, str]:
    """Return the generated C files with the variables of an FMU.

    Args:
        variables: variables in the order of their value references.
        token: text that identifies the content of the FMU.
        period: control period [s].
        constants: further constants of the model, by name.

    Returns:
        Text of each file by its name.
    """
    rows = (
        f'    {{"{variable.name}", {VARIABLE_TYPES[variable.type]}, {CAUSALITIES[variable.causality]}, '
        f"{', '.join(map(format_double, (variable.start, variable.lowest, variable.highest)))}}}"
        for variable in variables
    )
    return {
        "fmu_variables.h": _HEADER_TEMPLATE.format(
            token=token,
            period=format_double(period),
            constants="".join(f"#define {name} {value}\n" for name, value in constants.items()),
            references=",\n".join(f"    {variable.c_name}" for variable in variables),
        ),
        "fmu_variables.c": _TABLE_TEMPLATE.format(rows=",\n".join(rows)),
    }


def common_files(fmi: int) -> dict[str, str]:
    """Return the C files that do not depend on the model: FMI functions, and the headers of the standard."""
    names = ("fmu.h", "fmu.c", "fmu_log.h", "fmu_log.c", *FMI_FILES[fmi])
    headers = sorted((FOLDER / "headers").glob(f"fmi{fmi}*.h"))
    return {
        path.name: path.read_text(encoding="utf-8") for path in (*(FOLDER / "c" / n for n in names), *headers)
    }


def read_source(name: str) -> str:
    """Return the text of a C file of this package."""
    return (FOLDER / "c" / name).read_text(encoding="utf-8")


def files_to_compile(files: Sequence[str]) -> list[str]:
    """Return the names of the source files, without headers, in alphabetical order."""
    return sorted(name for name in files if name.endswith(".c"))
