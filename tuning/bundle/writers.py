"""Export of gain documents to the formats of other programs: ROS 2, MATLAB, CSV, C99, FMUs, and a rig in C.

`WRITERS` maps the name of each format (`--format`) to a function. The function takes a checked gain document
and returns the content of each file by its path. All formats preserve the bits of the numbers. A limit of
null is written as its default. To add a format, add a function and its entry in `WRITERS`.
"""

import copy
import csv
import io
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, format_value
from tuning.bundle.controller_kind import kind_of

ROS2_NODE = "/jaxhil_controller"
MAX_MATLAB_NAME_LENGTH = 63  # longest name of a struct's field in MATLAB [characters]
_MAT_HEADER = b"MATLAB 5.0 MAT-file, made by jaxhil export"


class GainOrLimit(NamedTuple):
    """Value, unit and bounds of a gain or limit."""

    value: float  # value in SI units
    unit: str  # unit of the value and of its bounds
    lower: float | None = None  # lower bound; None for a limit, which has no bounds
    upper: float | None = None  # upper bound; None for a limit


def gain_entries(document: Mapping[str, Any]) -> dict[str, GainOrLimit]:
    """Return the gains of a gain document by name."""
    return {
        name: GainOrLimit(float(gain["value"]), gain["unit"], float(gain["lower"]), float(gain["upper"]))
        for name, gain in document["gains"].items()
    }


def limit_entries(document: Mapping[str, Any]) -> dict[str, GainOrLimit]:
    """Return the limits of a gain document by name; empty if the document has no limits."""
    table = kind_of(document).limits
    return {
        name: GainOrLimit(
            table[name].default if limit["value"] is None else float(limit["value"]), limit["unit"]
        )
        for name, limit in document.get("limits", {}).items()
    }


def ros2_files(document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the content of `ros2.yaml`, a ROS 2 parameter file for the node `/jaxhil_controller`.

    Every number has a decimal point and every text is quoted, so that ROS 2 reads them as double and string.
    """
    import yaml

    class Dumper(yaml.SafeDumper):
        pass

    class Text(str):
        """Text that the YAML file contains in quotes."""

    Dumper.add_representer(
        Text, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", str(text), style='"')
    )
    gains, limits = gain_entries(document), limit_entries(document)
    parameters = {
        "compensator": Text(document["compensator"]),
        "control_period": float(document["control_period"]),
        "mechanism": Text(document["mechanism"]["name"]),
        "sha256": Text(document["sha256"]),
        "gains": {name: entry.value for name, entry in gains.items()},
        "limits": {name: entry.value for name, entry in limits.items()},
        "units": {
            "control_period": Text("s"),
            "gains": {name: Text(entry.unit) for name, entry in gains.items()},
            "limits": {name: Text(entry.unit) for name, entry in limits.items()},
        },
    }
    # ROS 2 does not accept empty tables.
    tables = {ROS2_NODE: {"ros__parameters": _without_empty(parameters)}}
    text = yaml.dump(tables, Dumper=Dumper, sort_keys=False, default_flow_style=False, width=1000)
    heading = f"# Parameters of the compensator {document['compensator']}, in SI units.\n"
    return {"ros2.yaml": (heading + text).encode("ascii")}


def matlab_files(document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the content of `gains.mat`, a MATLAB file that contains the struct `jaxhil`.

    The fields of this struct are compensator, control_period, mechanism, sha256, gains and limits. Each gain
    is a struct with the fields value, unit, lower and upper. Each limit is a struct with value and unit.
    """
    from scipy.io import savemat

    gains, limits = gain_entries(document), limit_entries(document)
    content = {
        "compensator": document["compensator"],
        "control_period": float(document["control_period"]),
        "mechanism": document["mechanism"]["name"],
        "sha256": document["sha256"],
        "gains": {name: entry._asdict() for name, entry in gains.items()} or np.empty((0, 0)),
        "limits": {name: {"value": entry.value, "unit": entry.unit} for name, entry in limits.items()}
        or np.empty((0, 0)),
    }
    for name in (*gains, *limits):
        if len(name) > MAX_MATLAB_NAME_LENGTH:
            raise InputError(
                f"matlab: {format_value(name)}: found {len(name)} characters, expected at most "
                f"{MAX_MATLAB_NAME_LENGTH}"
            )
    file = io.BytesIO()
    savemat(file, {"jaxhil": content}, format="5", long_field_names=True, oned_as="row")
    # SciPy writes the date into the first 116 characters. Replace it, so that equal gains give equal files.
    return {"gains.mat": _MAT_HEADER.ljust(116) + file.getvalue()[116:]}


def csv_files(document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the content of `gains.csv`, with the columns name, value, unit, lower and upper.

    Limits have the names `limits.NAME` and no bounds.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("name", *GainOrLimit._fields))
    entries = {
        "control_period": GainOrLimit(float(document["control_period"]), "s"),
        **gain_entries(document),
        **{f"limits.{name}": entry for name, entry in limit_entries(document).items()},
    }
    for name, entry in entries.items():
        writer.writerow((name, *(_format_cell(value) for value in entry)))
    return {"gains.csv": text.getvalue().encode("ascii")}


def c99_files(document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the controller's C99 files and a real-time loop, in the folder `c99`.

    Raise `InputError` if the compensator cannot be translated to C.
    """
    from tuning.bundle.c99 import generate_c99
    from tuning.bundle.rt_loop import rt_loop_files

    files = generate_c99(document) | rt_loop_files(document)
    return {f"c99/{name}": text.encode("ascii") for name, text in files.items()}


def fmi3_files(document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the FMUs of FMI 3.0 as source code without a compiled library, in the folder `fmi3`.

    One FMU contains the controller. Another FMU contains the rig, if an FMU can simulate this rig. A test
    program replays the test vectors through the controller's FMU.
    """
    return _fmu_files(document, 3)


def fmi2_files(document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the FMUs of FMI 2.0 as source code, in the folder `fmi2`; see `fmi3_files`."""
    return _fmu_files(document, 2)


def rehearsal_files(document: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the simulated rig in C for the real-time loop, in the folder `rehearsal`.

    Raise `InputError` if the rig has a property that its FMU cannot simulate.
    """
    from tuning.bundle.rt_rig import rig_plant_files

    return {f"rehearsal/{name}": text.encode("ascii") for name, text in rig_plant_files(document).items()}


def _fmu_files(document: Mapping[str, Any], fmi: int) -> dict[str, bytes]:
    from tuning.bundle.c99 import TEST_FILE
    from tuning.bundle.fmu import controller, rig

    files = {
        f"fmi{fmi}/{controller.IDENTIFIER}.fmu": controller.controller_fmu(document, fmi),
        f"fmi{fmi}/{TEST_FILE}": controller.fmu_test_program(document, fmi).encode("ascii"),
    }
    with suppress(rig.UnsupportedRig):  # `describe_fmus` names the reason
        files[f"fmi{fmi}/{rig.IDENTIFIER}.fmu"] = rig.rig_fmu(document, fmi)
    return files


def describe_fmus(document: Mapping[str, Any], files: Mapping[str, bytes]) -> list[str]:
    """Describe what the FMUs in a bundle lack: the rig, or a library for Linux."""
    from jaxhil.mechanism.file import any_from_plain_data
    from tuning.bundle.fmu import rig
    from tuning.bundle.fmu.archive import find_library

    archives = [content for name, content in files.items() if name.endswith(".fmu")]
    notes = []
    if archives:
        mechanism = any_from_plain_data(copy.deepcopy(document["mechanism"]), "gain document")
        unsupported = rig.describe_unsupported(mechanism)
        notes += [f"The rig has no FMU: {unsupported}."] if unsupported else []
    if any(find_library(archive) is None for archive in archives):
        notes.append(
            "The FMUs contain no library: found no C compiler, or it failed; their sources are complete."
        )
    return notes


WRITERS: dict[str, Callable[[Mapping[str, Any]], dict[str, bytes]]] = {
    "ros2": ros2_files,
    "matlab": matlab_files,
    "csv": csv_files,
    "c99": c99_files,
    "fmu": fmi3_files,
    "fmu2": fmi2_files,
    "rehearsal": rehearsal_files,
}
# Folder of each format that is written only on request: to generate a rig's C code can take seconds.
ON_REQUEST = {"fmu": "fmi3/", "fmu2": "fmi2/", "rehearsal": "rehearsal/"}


def _format_cell(value: float | str | None) -> str:
    """Return the text of a CSV cell; empty for None."""
    if value is None or isinstance(value, str):
        return value or ""
    return repr(value)


def _without_empty(value: Any) -> Any:
    """Remove empty dictionaries from nested dictionaries."""
    if not isinstance(value, dict):
        return value
    inner = {key: _without_empty(item) for key, item in value.items()}
    return {key: item for key, item in inner.items() if item != {}}
