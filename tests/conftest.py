"""What every test runs under: float64, strict promotion, two host devices, checked shapes."""

import os

from tuning.environment import settings

# The programs tested are those that users run, on two devices wherever the tests run.
os.environ["XLA_FLAGS"] = settings(
    {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "--xla_force_host_platform_device_count=2")}
)["XLA_FLAGS"]
os.environ["NPROC"] = settings(os.environ)["NPROC"]

import hypothesis
import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Shapes are checked where there are shapes: the modules that compute with arrays.
ARRAY_MODULES = (
    *("building", "contact", "integrators", "limits", "loop", "metrics", "reference"),
    *("reference_laws", "ring", "rollout", "scenario", "sensors", "simulator", "compensators"),
)
install_import_hook([f"jaxhil.{name}" for name in ARRAY_MODULES], "beartype.beartype")

# A shared machine has no deadlines to keep, and a test that fails must fail again.
hypothesis.settings.register_profile("jaxhil", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxhil")
