"""Contact simulation of a hardware-in-the-loop docking rig, and the controller that runs on the rig.

    load       read a mechanism file or a built-in mechanism, with one axis or six axes
    simulate   simulate the contacts of a mechanism with a compensator, once
    jacobian   differentiate a metric of each contact with respect to mechanism parameters and gains
    register   add your own compensator or contact law

Numbers are in SI units. Arrays are NumPy arrays of float64, whatever precision JAX uses. An invalid argument
raises `InputError` with a one-line message. Modules are imported on first use, so that the rig's controller
`jaxhil.rig` needs neither JAX nor NumPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxhil.api import simulate
    from jaxhil.contact.base import ContactLaw
    from jaxhil.errors import InputError
    from jaxhil.laws.simulation_base import Compensator, Gain
    from jaxhil.mechanism.loading import load
    from jaxhil.mechanism.structs import Mechanism
    from jaxhil.simulation.jacobian import jacobian
    from jaxhil.simulation.registration import register

    __version__: str

__all__ = [
    "Compensator",
    "ContactLaw",
    "Gain",
    "InputError",
    "Mechanism",
    "__version__",
    "jacobian",
    "load",
    "register",
    "simulate",
]

_MODULES = {
    "Compensator": "jaxhil.laws.simulation_base",
    "ContactLaw": "jaxhil.contact.base",
    "Gain": "jaxhil.laws.simulation_base",
    "InputError": "jaxhil.errors",
    "Mechanism": "jaxhil.mechanism.structs",
    "jacobian": "jaxhil.simulation.jacobian",
    "load": "jaxhil.mechanism.loading",
    "register": "jaxhil.simulation.registration",
    "simulate": "jaxhil.api",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("jaxhil")
    if name not in _MODULES:
        raise AttributeError(f"module 'jaxhil' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
