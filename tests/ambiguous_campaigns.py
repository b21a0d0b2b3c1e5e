"""Campaigns whose contacts hardly distinguish damping from force delay, and their errors in e and e - e*."""

import campaign_kinds
import campaigns
import numpy as np
from msgspec.structs import replace

from jaxhil.mechanism.file import from_plain_data, to_plain_data
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import build_scenarios

SOFT = campaign_kinds.voigt((124355.0,), (264.0,))  # ratio of damping to stiffness: 2.1 ms
RIG = campaign_kinds.rig
KINDS = {
    "plain": campaign_kinds.Kind(RIG(), SOFT),
    "lag": campaign_kinds.Kind(RIG(force_sensor__time_constant=0.0016, position_sensor__delay=0.0011), SOFT),
    "hidden": campaign_kinds.Kind(RIG(force_sensor__dead_zone=6.0), SOFT),
    "coloured 2 N": campaign_kinds.Kind(RIG(noise=2.0), SOFT, colour=0.6),
    "lost rows": campaign_kinds.Kind(RIG(), SOFT, jitter=5e-5, lost=0.01),
    "undamped": campaign_kinds.Kind(RIG(), campaign_kinds.voigt((124355.0,), (0.0,))),
    "no delay": campaign_kinds.Kind(RIG(force_sensor__delay=0.0), SOFT),
}
PHASES = np.arange(4) / 4.0
TOLD = ("natural_frequency", "damping_ratio", "delay")


def campaign(monkeypatch, name, seed, **changes):
    monkeypatch.setitem(campaigns.KINDS, name, KINDS[name])
    return campaigns.campaign(name, seed, **changes)


def prior(name):
    """Return a prior with stiffness, inaccurate motion simulator and delay of the position sensor.

    The prior has no damping, and its force sensor has no delay, lag or dead zone.
    """
    sensor = {"delay": KINDS[name].rig["position_sensor"].get("delay", 0.0)}
    simulator = {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8, "delay": 0.004}
    return from_plain_data({
        "schema": "jaxhil/mechanism/1", "name": "prior", "bodies": {"equivalent_mass": 350.0},
        "approach": {"velocity": 0.006},
        "contact": {"law": "kelvin_voigt", "stiffness": [124355.0]},
        "rig": {"control_period": 0.001, "simulator": simulator, "position_sensor": sensor},
    }, "prior")  # fmt: skip


def truth(name):
    """Return the mechanism file of the true rig, without noise and dead zone."""
    kind = KINDS[name]
    raw = to_plain_data(prior(name))
    raw["contact"] = {**kind.contact}
    sensor = {key: one for key, one in kind.rig["force_sensor"].items() if key in ("delay", "time_constant")}
    raw["rig"] |= {"simulator": {**kind.rig["simulator"]}, "force_sensor": sensor}
    return from_plain_data(raw, name)


def numbers(mechanism, position_delay):
    """Return, by key, the rig's parameters that determine e and e*, for this position sensor delay [s].

    A rig whose motion and force delays are smaller by d, and whose position sensor delay is larger by d,
    gives the same readings.
    """
    rig = mechanism.rig
    values = {f"rig.simulator.{key}": getattr(rig.simulator, key) for key in TOLD}
    values |= {
        f"rig.force_sensor.{key}": getattr(rig.force_sensor, key) for key in ("delay", "time_constant")
    }
    share = rig.position_sensor.delay - position_delay
    values["rig.simulator.delay"] += share
    values["rig.force_sensor.delay"] = max(values["rig.force_sensor.delay"] - share, 0.0)
    return values


def deviations(name, written, compensator, gains):
    """Return the errors of e and e - e* of each mechanism, compared with the true rig, (mechanisms, 2).

    All mechanisms run with the same gains in the simulation of `jaxhil`; e is averaged over contact phases.
    """
    true = truth(name)
    voigt = [index for index, one in enumerate(written) if one.contact.law == true.contact.law]
    table = np.empty((len(written) + 1, 2))
    table[[0, *(index + 1 for index in voigt)]] = _errors(
        true, [true, *(written[index] for index in voigt)], compensator, gains
    )
    for index in {*range(len(written))} - {*voigt}:
        other = replace(true, contact=written[index].contact)
        table[index + 1] = _errors(other, [written[index]], compensator, gains)
    return table[1:] - table[0]


def _errors(template, mechanisms, compensator, gains):
    """Return e and e - e* of mechanisms that have the template's contact law, (mechanisms, 2)."""
    every = [numbers(one, template.rig.position_sensor.delay) for one in mechanisms]
    if len(mechanisms) > 1:
        for values, one in zip(every, mechanisms, strict=True):
            values |= {f"contact.{key}": getattr(one.contact, key)[0] for key in ("stiffness", "damping")}
    draws = {
        key: np.repeat([values[key] for values in every], len(PHASES))
        for key in every[0]
        if any(values[key] for values in every)
    }
    draws["approach.phase"] = np.tile(PHASES, len(every))
    scenarios = build_scenarios(template, draws, 0)
    metrics = evaluate(build_loop(template, compensator, scenarios), gains, scenarios)
    assert np.array_equal(metrics.good, metrics.is_scheduled)
    e, error = np.asarray(metrics.metrics.restitution)[0], np.asarray(metrics.error)[0]
    return np.array([e, error]).reshape(2, len(every), len(PHASES)).mean(axis=2).T
