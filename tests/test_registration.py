"""User-registered compensators and contact laws: registered, simulated, differentiated, or rejected."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from test_api import KEYS, TWO, refusal
from user_registered_laws import ScaledLead, ScaledLeadOnTheRig, SquaredSpring

import jaxhil
from jaxhil.contact import laws
from jaxhil.contact.keys import ContactKey
from jaxhil.mechanism.uncertainty import draw
from tuning.identification import mechanism_models
from tuning.rig.plant import RigHardware
from tuning.transparency.damping_perturbations import perturb_damping


@pytest.fixture(scope="module")
def registered():
    for law in (ScaledLead(), SquaredSpring()):
        jaxhil.register(law)
        jaxhil.register(law)  # like a notebook cell that runs twice


def test_user_registered_compensator_is_simulated(registered):
    """The compensator equals the built-in phase lead without its filter, so the results differ little."""
    mechanism = jaxhil.load("varying", TWO)
    plain, none = jaxhil.simulate(mechanism, "scaled_lead", {"toy_lead": 0.0}), jaxhil.simulate(mechanism)
    assert [c.restitution for c in plain.contacts] == [c.restitution for c in none.contacts]
    run = jaxhil.simulate(mechanism, "scaled_lead")
    assert run.gains == {"toy_lead": mechanism.rig.force_sensor.delay}
    filtered = jaxhil.simulate(mechanism, "phase_lead").contacts[0].error
    assert run.contacts[0].error == pytest.approx(filtered, abs=2e-3)
    assert run.contacts[0].error < none.contacts[0].error - 0.1
    by = ["gains.toy_lead"] * len(KEYS)  # the same number as in other tests, to share a program
    slope = jaxhil.jacobian(mechanism, "scaled_lead", by=by)["gains.toy_lead"]
    step = 1e-6
    high, low = (
        np.array(
            [c.restitution for c in jaxhil.simulate(mechanism, "scaled_lead", {"toy_lead": value}).contacts]
        )
        for value in (run.gains["toy_lead"] + step, run.gains["toy_lead"] - step)
    )
    np.testing.assert_allclose(slope, (high - low) / (2 * step), rtol=1e-5)


def test_user_registered_contact_law_agrees_with_its_integrated_ideal_contact(registered):
    overrides = {"contact": {"law": "squared_spring", "stiffness": [1e8]}, "approach.contacts": 1}
    prompt = {"rig.simulator": {"model": "ideal"}, "rig.force_sensor.delay": 0.0, "uncertainty": {}}
    mechanism = jaxhil.load("rig-300kg", overrides | prompt)
    [contact] = jaxhil.simulate(mechanism, "phase_lead").contacts
    # M v^2/2 = k d^3/3 at the deepest point: no energy is lost.
    mass, speed = mechanism.bodies.mass, mechanism.approach.velocity
    deepest = (1.5 * mass * speed**2 / 1e8) ** (1 / 3)
    assert contact.reference_restitution == pytest.approx(1.0, abs=1e-8)
    assert contact.reference_peak_force == pytest.approx(1e8 * deepest**2, rel=1e-8)
    assert contact.status == "ok" and contact.restitution == pytest.approx(1.0, abs=0.01)
    by = "contact.stiffness"
    slope = jaxhil.jacobian(mechanism, "phase_lead", of="reference_peak_force", by=by)[by]
    # F = k (1.5 M v^2/k)^(2/3), hence dF/dk = F/(3 k).
    np.testing.assert_allclose(slope, contact.reference_peak_force / 3e8, rtol=1e-6)


def test_incomplete_contact_law_is_rejected(registered):
    mechanism = jaxhil.load("rig-300kg", {"contact": {"law": "squared_spring", "stiffness": [1e8]}})
    for needs, method in (
        (lambda: perturb_damping(mechanism, draw(mechanism, 4, 0)), "perturb_damping"),
        (lambda: RigHardware(mechanism), "as_float_law"),
        (lambda: mechanism_models.make_regression_law(mechanism.contact), "regression"),
    ):
        message = refusal(needs)
        assert message.startswith("contact.law: found 'squared_spring', expected a law ")
        assert message.endswith(f"a law that defines ContactLaw.{method}")
    assert "contact.law: found 'none', expected one of linear, " in refusal(laws.find_contact_law, "none")


def test_contact_laws_with_shared_key_must_describe_the_key_identically():
    for law in laws.CONTACT_LAWS.values():
        assert all(laws.CONTACT_KEYS[key.name] == key for key in law.keys or ())


def test_unusable_compensator_or_contact_law_is_not_registered(registered):
    class Unnamed(SquaredSpring):
        name = ""

    class Taken(ScaledLead):
        name = "phase_lead"

    class Boundless(ScaledLead):
        name = "boundless"
        gains = (jaxhil.Gain("toy_lead", "s", lambda m: 0.0, lambda m: math.inf, lambda m: 1.0),)

    class Broken(ScaledLead):
        name = "broken"
        gains = (jaxhil.Gain("toy_lead", "s", lambda m: m.nothing, lambda m: 1.0, lambda m: 1.0),)

    class Unitless(ScaledLead):
        name = "unitless"
        gains = (jaxhil.Gain("toy_lead", "", lambda m: 0.0, lambda m: 1.0, lambda m: 1.0),)

    class OfItsOwnKey(SquaredSpring):
        name = "of_its_own_key"
        keys = (ContactKey("toy_depth", "of a toy", "m"),)

    class Holding(ScaledLead):
        name = "holding"
        table: jnp.ndarray = eqx.field(default_factory=lambda: jnp.ones(3))

    for law, message in (
        (ScaledLead, "found the class ScaledLead, expected an instance of"),
        (3, "found 3, expected an instance of"),
        (Unnamed(), "Unnamed.name: found"),
        (Taken(), "register phase_lead: name: found the name of a registered law"),
        (
            Boundless(),
            "gains.toy_lead: found lower 0, nominal 1, upper inf, expected lower <= nominal <= upper",
        ),
        (Broken(), "gains.toy_lead.lower: found AttributeError"),
        (Unitless(), "gains.toy_lead.unit: found ''"),
        (Holding(), "expected only numbers, texts and tuples (no arrays)"),
        (OfItsOwnKey(), "keys: found toy_depth, expected keys of mechanism files: tension, exponent, "),
    ):
        assert message in refusal(jaxhil.register, law)
    assert "expected one of none" in refusal(jaxhil.simulate, "varying", "holding")
    assert "expected none: contact laws run in the simulation only" in refusal(
        jaxhil.register, SquaredSpring(), runtime=ScaledLeadOnTheRig
    )
    assert "expected a class" in refusal(
        jaxhil.register, ScaledLead(), runtime=ScaledLeadOnTheRig({"toy_lead": 0}, 1, 1)
    )
    assert "found object without method step" in refusal(jaxhil.register, ScaledLead(), runtime=object)
    jaxhil.register(ScaledLead(), runtime=ScaledLeadOnTheRig)
    jaxhil.register(ScaledLead())


@pytest.mark.slow
def test_redefined_compensator_replaces_the_earlier_definition():
    def defined(share):
        class Share(ScaledLead):
            name = "share"

            def step(self, prepared, state, signals, tick):
                return share * signals.force_measured, state

        return Share()

    restitutions = []
    for share in (1.0, 0.98):
        jaxhil.register(defined(share))
        restitutions.append(jaxhil.simulate(jaxhil.load("varying", TWO), "share").contacts[0].restitution)
    assert abs(restitutions[0] - restitutions[1]) > 1e-3
