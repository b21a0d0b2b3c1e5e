"""Deprecated alias of the package `jaxhil.rig`, available for one more release.

The alias has the same modules: `jaxhil.runtime.controller` is `jaxhil.rig.controller`.
"""

import sys
import warnings
from importlib import import_module
from pkgutil import iter_modules

import jaxhil.rig

warnings.warn("jaxhil.runtime is now called jaxhil.rig", DeprecationWarning, stacklevel=2)
for _module in iter_modules(jaxhil.rig.__path__):
    sys.modules[f"{__name__}.{_module.name}"] = import_module(f"jaxhil.rig.{_module.name}")
sys.modules[__name__] = jaxhil.rig
