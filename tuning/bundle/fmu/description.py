"""XML files of an FMU: `modelDescription.xml`, and `buildDescription.xml` of FMI 3."""

import math
import re
from collections.abc import Collection, Sequence
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from tuning.bundle.fmu.variables import Variable
from tuning.bundle.manifest import package_version

# Exponents of the SI base units in the units of this program.
BASE_UNITS = {
    "N": {"kg": 1, "m": 1, "s": -2},
    "kg": {"kg": 1},
    "m": {"m": 1},
    "s": {"s": 1},
    "rad": {"rad": 1},
}
TYPES = {
    2: {"real": "Real", "integer": "Integer", "boolean": "Boolean", "string": "String"},
    3: {"real": "Float64", "integer": "Int32", "boolean": "Boolean", "string": "String"},
}
LOG_CATEGORY = "logStatusError"
_UNIT_FACTOR = re.compile(r"([A-Za-z]+)(?:\^(-?\d+))?$")


class FmuDescription(NamedTuple):
    """Content of an FMU's description."""

    identifier: str  # identifier of the model, which is the name of the library
    name: str  # name that other tools display
    description: str
    token: str  # identifies the content of the FMU
    period: float  # control period, which is the communication step [s]
    variables: Sequence[Variable]
    sources: Sequence[str]  # names of the source files to compile
    initial_inputs: Collection[str]  # names of the inputs on which outputs depend before the first step


def model_description(fmu: FmuDescription, fmi: int) -> bytes:
    """Return the content of `modelDescription.xml` for version 2 or 3 of FMI."""
    attributes = {
        "fmiVersion": f"{fmi}.0",
        "modelName": fmu.name,
        "guid" if fmi == 2 else "instantiationToken": fmu.token,
        "description": fmu.description,
        "generationTool": package_version(),
        "variableNamingConvention": "structured",
    }
    root = Element("fmiModelDescription", attributes)
    capabilities = {"modelIdentifier": fmu.identifier, "canHandleVariableCommunicationStepSize": "false"}
    if fmi == 2:
        capabilities |= {"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true"}
        simulation = SubElement(root, "CoSimulation", capabilities)
        files = SubElement(simulation, "SourceFiles")
        for name in fmu.sources:
            SubElement(files, "File", name=name)
    else:
        capabilities |= {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true"}
        SubElement(root, "CoSimulation", capabilities, fixedInternalStepSize=repr(fmu.period))
    _add_units(root, fmu.variables)
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", name=LOG_CATEGORY, description="calls that return an error")
    SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(fmu.period))
    listed = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(fmu.variables):
        if fmi == 3 or variable.causality != "independent":
            _add_variable(listed, reference, variable, fmi)
    _add_structure(root, fmu, fmi)
    return _to_bytes(root)


def build_description(fmu: FmuDescription) -> bytes:
    """Return the content of `sources/buildDescription.xml` of FMI 3."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=fmu.identifier)
    files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in fmu.sources:
        SubElement(files, "SourceFile", name=name)
    SubElement(configuration, "Library", name="m", description="mathematical functions of C", external="true")
    return _to_bytes(root)


def unit_exponents(unit: str) -> dict[str, int] | None:
    """Return the exponents of the SI base units in a unit such as "N s/m^2"; None for other texts."""
    exponents: dict[str, int] = {}
    numerator, _, denominator = unit.partition("/")
    for sign, text in ((1, numerator), (-1, denominator)):
        for factor in text.split():
            match = _UNIT_FACTOR.match(factor)
            if factor == "1":
                continue
            if match is None or match[1] not in BASE_UNITS:
                return None
            for base, power in BASE_UNITS[match[1]].items():
                exponents[base] = exponents.get(base, 0) + sign * power * int(match[2] or 1)
    return {base: power for base, power in exponents.items() if power}


def _add_units(root: Element, variables: Sequence[Variable]) -> None:
    """Add the XML definitions of all units that the variables use."""
    units = SubElement(root, "UnitDefinitions")
    for name in dict.fromkeys(variable.unit for variable in variables):
        if name == "1":
            continue
        unit = SubElement(units, "Unit", name=name)
        exponents = unit_exponents(name)
        if exponents is not None:
            SubElement(unit, "BaseUnit", {base: str(power) for base, power in exponents.items()})


def _add_variable(listed: Element, reference: int, variable: Variable, fmi: int) -> None:
    """Add a variable's XML element; in FMI 2, an inner element has the attributes that depend on the type."""
    common = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.description,
        "causality": variable.causality,
    }
    typed = {}
    if variable.causality != "independent":
        common["variability"] = "fixed" if variable.causality == "parameter" else "discrete"
    else:
        common["variability"] = "continuous"
    if variable.causality == "output":
        common["initial"] = "calculated"
    if variable.type == "real":
        if variable.unit != "1":
            typed["unit"] = variable.unit
        if math.isfinite(variable.lowest):
            typed["min"] = repr(variable.lowest)
        if math.isfinite(variable.highest):
            typed["max"] = repr(variable.highest)
    if variable.causality in ("input", "parameter") and (variable.type != "string" or fmi == 2):
        typed["start"] = _start_text(variable)
    name = TYPES[fmi][variable.type]
    if fmi == 3:
        element = SubElement(listed, name, {**common, **typed})
        if variable.type == "string":
            SubElement(element, "Start", value="")
    else:
        SubElement(SubElement(listed, "ScalarVariable", common), name, typed)


def _start_text(variable: Variable) -> str:
    """Return the start value of a variable as XML text."""
    if variable.type == "string":
        return ""
    if variable.type == "boolean":
        return "true" if variable.start else "false"
    return str(int(variable.start)) if variable.type == "integer" else repr(float(variable.start))


def _add_structure(root: Element, fmu: FmuDescription, fmi: int) -> None:
    """Add the XML element `ModelStructure`, which lists the outputs.

    The outputs change only at the ends of steps. The list therefore states no direct dependency on an input.
    Before the first step, outputs depend on parameters and on a few inputs. If the list did not state them,
    importing tools would assume all inputs, and solve equations between controller and rig.
    """
    structure = SubElement(root, "ModelStructure")
    outputs = [n for n, variable in enumerate(fmu.variables) if variable.causality == "output"]
    dependencies = " ".join(
        str(n)
        for n, variable in enumerate(fmu.variables)
        if variable.causality == "parameter" or variable.name in fmu.initial_inputs
    )
    if fmi == 3:
        for reference in outputs:
            SubElement(structure, "Output", valueReference=str(reference), dependencies="")
        for reference in outputs:
            SubElement(structure, "InitialUnknown", valueReference=str(reference), dependencies=dependencies)
        return
    # FMI 2 counts the listed variables from 1, and the time is not listed.
    listed, unknowns = SubElement(structure, "Outputs"), SubElement(structure, "InitialUnknowns")
    for reference in outputs:
        SubElement(listed, "Unknown", index=str(reference), dependencies="")
        SubElement(unknowns, "Unknown", index=str(reference), dependencies=dependencies)


def _to_bytes(root: Element) -> bytes:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"
