"""Former name of `jaxhil.rig`, available for one more release.

Its modules, such as `jaxhil.runtime.controller`, are those of `jaxhil.rig`.
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
