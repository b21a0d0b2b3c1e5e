"""The compensation laws by name: the one entry that a law has anywhere.

The law `<name>` is `jaxhil/compensators/<name>.py` in JAX and `jaxhil/runtime/laws/<name>.py` in plain
Python, of which `jaxhil.codegen` makes C99. Simulation, tuning, command line, export and tests go by this
list; `PUBLISHED` are those of the literature, the rest is ours.
"""

PUBLISHED = (
    "none",
    "phase_lead",
    "multi_parameter_lead",
    "smith_predictor",
    "smith_hybrid",
    "position_lead",
    "virtual_contact",
    "dead_zone_observer",
    "passivity",
    "response_error",
)
LAWS = (*PUBLISHED, "impulse_ledger")
