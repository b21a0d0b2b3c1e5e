"""Instance of an FMU whose library is compiled from the sources in its archive and called with ctypes."""

import ctypes
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tuning.bundle.fmu.archive import DESCRIPTION_FILE, compile_library
from tuning.bundle.fmu.variables import Variable

# For each type of variable: the name in FMI 3.0 and in FMI 2.0, and the types of its values.
TYPES: Mapping[str, tuple[tuple[str, Any], tuple[str, Any]]] = {
    "real": (("Float64", ctypes.c_double), ("Real", ctypes.c_double)),
    "integer": (("Int32", ctypes.c_int32), ("Integer", ctypes.c_int)),
    "boolean": (("Boolean", ctypes.c_bool), ("Boolean", ctypes.c_int)),
}
CO_SIMULATION = 1  # type of an FMU in FMI 2.0


class FmuError(Exception):
    """Error of a function of an FMU, or of its compilation."""


class FmuInstance:
    """Instance of an FMU on this computer; the library of the archive is not used.

    Args:
        archive: archive of the FMU.
        variables: variables in the order of their value references.
        period: communication step [s].

    Raises:
        FmuError: If the sources cannot be compiled, or the FMU refuses to run.
    """

    def __init__(self, archive: bytes, variables: Sequence[Variable], period: float) -> None:
        self._references = {variable.name: number for number, variable in enumerate(variables)}
        self._types = {variable.name: variable.type for variable in variables}
        self._period, self._ticks = period, 0
        with zipfile.ZipFile(BytesIO(archive)) as file:
            root = ElementTree.fromstring(file.read(DESCRIPTION_FILE))
        self._fmi = int(root.attrib["fmiVersion"][0])
        library = compile_library(archive)
        if library is None:
            raise FmuError("the sources cannot be compiled")
        with tempfile.TemporaryDirectory(prefix="jaxhil-fmu-") as folder:
            path = Path(folder) / "library.so"
            path.write_bytes(library)
            self._library = ctypes.CDLL(str(path))  # stays loaded after the file is deleted
        token = root.attrib["instantiationToken" if self._fmi == 3 else "guid"].encode()
        self._instance = self._instantiate(token)
        if not self._instance:
            raise FmuError("the instantiation failed")

    def begin(self, **values: float) -> None:
        """Set parameters and inputs, and initialise at time 0."""
        zero, no = ctypes.c_double(0.0), ctypes.c_bool(False)
        if self._fmi == 3:
            self._call("EnterInitializationMode", no, zero, zero, no, zero)
        else:
            self._call("SetupExperiment", 0, zero, zero, 0, zero)
            self._call("EnterInitializationMode")
        self.set(values)
        self._call("ExitInitializationMode")

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables by name."""
        for name, value in values.items():
            suffix, type_ = TYPES[self._types[name]][self._fmi == 2]
            self._exchange(f"Set{suffix}", name, type_(value))

    def get(self, *names: str) -> dict[str, float]:
        """Return the values of variables by name."""
        values = {}
        for name in names:
            suffix, type_ = TYPES[self._types[name]][self._fmi == 2]
            values[name] = type_()
            self._exchange(f"Get{suffix}", name, values[name])
        return {name: value.value for name, value in values.items()}

    def step(self) -> None:
        """Compute one communication step."""
        time, period = ctypes.c_double(self._ticks * self._period), ctypes.c_double(self._period)
        flags, last = [ctypes.byref(ctypes.c_bool()) for _ in range(3)], ctypes.byref(ctypes.c_double())
        if self._fmi == 3:
            self._call("DoStep", time, period, ctypes.c_bool(True), *flags, last)
        else:
            self._call("DoStep", time, period, 1)
        self._ticks += 1

    def close(self) -> None:
        """Free the instance."""
        free = getattr(self._library, f"fmi{self._fmi}FreeInstance")
        free.restype = None
        free(ctypes.c_void_p(self._instance))

    def _instantiate(self, token: bytes) -> int | None:
        name, no = b"verification", ctypes.c_bool(False)
        if self._fmi == 3:
            function = self._library.fmi3InstantiateCoSimulation
            function.restype = ctypes.c_void_p
            return function(name, token, None, no, no, no, no, None, ctypes.c_size_t(0), None, None, None)
        function = self._library.fmi2Instantiate
        function.restype = ctypes.c_void_p
        return function(name, CO_SIMULATION, token, b"", None, 0, 0)

    def _exchange(self, function: str, name: str, value: Any) -> None:
        reference = ctypes.byref(ctypes.c_uint32(self._references[name]))
        counts = (ctypes.c_size_t(1),) if self._fmi == 3 else ()
        self._call(function, reference, ctypes.c_size_t(1), ctypes.byref(value), *counts)

    def _call(self, function: str, *values: Any) -> None:
        status = getattr(self._library, f"fmi{self._fmi}{function}")(ctypes.c_void_p(self._instance), *values)
        if status != 0:
            raise FmuError(f"fmi{self._fmi}{function}: returned the status {status}")
