"""A gain document as other programs read it: ROS 2 parameters, MATLAB, CSV, C99.

`WRITERS` holds them by the name that `--format` takes; each makes files, by their paths in the bundle, of a
checked gain document. Numbers come back as the same doubles; a limit of null as what it means. To add
a format is one function here and its entry in `WRITERS`.
"""

import csv
import io
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, shown
from jaxhil.rig.limits import LIMITS

NODE = "/jaxhil_controller"
LONGEST_MATLAB_NAME = 63
_MAT_HEADER = b"MATLAB 5.0 MAT-file, made by jaxhil export"


class Entry(NamedTuple):
    """A gain or a limit."""

    value: float  # [SI]
    unit: str  # of the value
    lower: float | None = None  # bound; None for a limit, which has none
    upper: float | None = None  # likewise


def gain_entries(document: Mapping[str, Any]) -> dict[str, Entry]:
    """The document's gains by name."""
    return {
        name: Entry(float(one["value"]), one["unit"], float(one["lower"]), float(one["upper"]))
        for name, one in document["gains"].items()
    }


def limit_entries(document: Mapping[str, Any]) -> dict[str, Entry]:
    """The document's limits by name; none in a document without."""
    return {
        name: Entry(_limit(name, one["value"]), one["unit"])
        for name, one in document.get("limits", {}).items()
    }


def ros2_yaml(document: Mapping[str, Any]) -> dict[str, bytes]:
    """A ROS 2 parameter file: `/jaxhil_controller: ros__parameters:`, gains and limits by nested names.

    Every number is a double to ROS 2 (it has a decimal point), every text is quoted: neither can be taken for
    another type.
    """
    import yaml

    class Dumper(yaml.SafeDumper):
        pass

    class Text(str):
        """A value, as against a name."""

    Dumper.add_representer(
        Text, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", str(text), style='"')
    )
    gains, limits = gain_entries(document), limit_entries(document)
    parameters = {
        "compensator": Text(document["compensator"]),
        "control_period": float(document["control_period"]),
        "mechanism": Text(document["mechanism"]["name"]),
        "sha256": Text(document["sha256"]),
        "gains": {name: one.value for name, one in gains.items()},
        "limits": {name: one.value for name, one in limits.items()},
        "units": {
            "control_period": Text("s"),
            "gains": {name: Text(one.unit) for name, one in gains.items()},
            "limits": {name: Text(one.unit) for name, one in limits.items()},
        },
    }
    # ROS 2 takes no empty table.
    tables = {NODE: {"ros__parameters": _without_empty(parameters)}}
    text = yaml.dump(tables, Dumper=Dumper, sort_keys=False, default_flow_style=False, width=1000)
    heading = f"# Parameters of the compensator {document['compensator']}, in SI units.\n"
    return {"ros2.yaml": (heading + text).encode("ascii")}


def matlab(document: Mapping[str, Any]) -> dict[str, bytes]:
    """`gains.mat`: a struct `jaxhil` with fields compensator, control_period, mechanism, sha256, gains,
    limits; each gain and limit is a struct of value, unit and, for gains, lower and upper."""
    from scipy.io import savemat

    gains, limits = gain_entries(document), limit_entries(document)
    content = {
        "compensator": document["compensator"],
        "control_period": float(document["control_period"]),
        "mechanism": document["mechanism"]["name"],
        "sha256": document["sha256"],
        "gains": {name: one._asdict() for name, one in gains.items()} or np.empty((0, 0)),
        "limits": {name: {"value": one.value, "unit": one.unit} for name, one in limits.items()}
        or np.empty((0, 0)),
    }
    for name in (*gains, *limits):
        if len(name) > LONGEST_MATLAB_NAME:
            allowed = f"allowed {LONGEST_MATLAB_NAME}"
            raise InputError(f"matlab: {shown(name)}: found {len(name)} characters, {allowed}")
    file = io.BytesIO()
    savemat(file, {"jaxhil": content}, format="5", long_field_names=True, oned_as="row")
    # The file begins with a text of 116 characters, in which SciPy writes the date: equal gains, equal files.
    return {"gains.mat": _MAT_HEADER.ljust(116) + file.getvalue()[116:]}


def csv_table(document: Mapping[str, Any]) -> dict[str, bytes]:
    """`gains.csv`: name, value, unit, lower, upper; limits under `limits.NAME`, without bounds."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("name", *Entry._fields))
    entries = {
        "control_period": Entry(float(document["control_period"]), "s"),
        **gain_entries(document),
        **{f"limits.{name}": one for name, one in limit_entries(document).items()},
    }
    for name, one in entries.items():
        writer.writerow((name, *(_cell(value) for value in one)))
    return {"gains.csv": text.getvalue().encode("ascii")}


def c99(document: Mapping[str, Any]) -> dict[str, bytes]:
    """The controller in C99, in the folder `c99`. Raises `InputError` for a law that has no C."""
    from tuning.bundle.c99 import c99_texts

    return {f"c99/{name}": text.encode("ascii") for name, text in c99_texts(document).items()}


WRITERS: dict[str, Callable[[Mapping[str, Any]], dict[str, bytes]]] = {
    "ros2": ros2_yaml,
    "matlab": matlab,
    "csv": csv_table,
    "c99": c99,
}


def _limit(name: str, value: float | None) -> float:
    # Null is what holds without the limit.
    return LIMITS[name].default if value is None else float(value)


def _cell(value: float | str | None) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return repr(value)


def _without_empty(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    inner = {key: _without_empty(one) for key, one in value.items()}
    return {key: one for key, one in inner.items() if one != {}}
