"""Rigs of simulated campaigns: as mechanism files, and under specified commands."""

import campaigns
import numpy as np
from oracle_contact import Law

from jaxhil.mechanism.file import from_plain_data


def mechanism(name, **changed):
    """Return the mechanism file of a kind of rig with replaced values; keys are "section__key"."""
    kind = campaigns.KINDS[name]
    rig = {key: {**value} if isinstance(value, dict) else value for key, value in kind.rig.items()}
    tables = {"contact": {**kind.contact}, **{one: rig[one] for one in rig if isinstance(rig[one], dict)}}
    tables["rig"] = rig
    for path, value in changed.items():
        section, key = path.split("__")
        tables[section][key] = value
    bodies, approach = {"equivalent_mass": kind.mass}, {"velocity": 0.006, "contacts": 1}
    approach["contacts"] = len(kind.contact["stiffness"])
    whole = {"schema": "jaxhil/mechanism/1", "name": name, "bodies": bodies, "approach": approach}
    return from_plain_data({**whole, "contact": tables["contact"], "rig": rig}, name)


def commanded(name, what, command, seed, noise=True):
    """Return a "free" or "press" run of a kind of rig under a command [m].

    A press run may start in contact.
    """
    kind, rng = campaigns.KINDS[name], np.random.default_rng(seed)
    rig, T, sensor = kind.rig, kind.rig["control_period"], kind.rig["force_sensor"]
    plant, law = campaigns.Plant(rig), Law(kind.contact, rig.get("contact_plane", 0.0))
    simulator_delay = rig["simulator"].get("delay", 0.0)
    measured = campaigns._position(
        plant, command, (simulator_delay + rig["position_sensor"].get("delay", 0.0)) / T
    )
    lag, near = (simulator_delay + sensor.get("delay", 0.0)) / T, 1e-3
    before, at, after = (campaigns._position(plant, command, lag + shift) for shift in (near, 0.0, -near))
    raw = law.raw(at - law.plane, (after - before) / (2.0 * near * T), 0)
    force = np.where((at > law.plane) & (what == "press"), np.maximum(raw, 0.0), 0.0)
    force = force + noise * campaigns._coloured(rng, len(command), sensor["noise_std"], kind.colour)
    measured = measured + noise * rig["position_sensor"]["noise_std"] * rng.standard_normal(len(command))
    return campaigns._run(kind, what, command, measured, campaigns.sense(force, sensor))
