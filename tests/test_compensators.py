"""Properties of every registered compensator.

Other tests of every registered compensator: agreement of JAX with the runtime (`test_agreement`), agreement
of C with Python (`test_c99`), and the bundle with its self-test (`test_export`).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gain_documents import GAINS, gain_document, sign
from lanes import QUICK

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.shared import nominal_values as known
from jaxhil.laws.simulation_base import Compensator, KnownConstants, Signals
from jaxhil.mechanism.file import load
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.rig import Controller, GainFileError

LAWS = tuple(COMPENSATORS)
WITH_GAINS = tuple(name for name, law in COMPENSATORS.items() if law.gains)
# The gains of position_lead act on the position command: see its own test.
ON_THE_FORCE = tuple(
    name for name in WITH_GAINS if type(COMPENSATORS[name]).position_command is Compensator.position_command
)
PERIOD, TICKS, RING, GAP = 1e-3, 200, 64, 2e-4
IDEAL = ("uncertainty={}", 'rig.simulator={model="ideal", delay=0.004}')
HOSTILE = {
    "no delay, ideal": ["rig.force_sensor.delay=0", *IDEAL, "rig.simulator.delay=0"],
    "long delay": ["rig.force_sensor.delay=0.09", "rig.simulator.delay=0.05"],
    "lagging sensor": ["rig.force_sensor.delay=0", "rig.force_sensor.time_constant=0.02"],
    "dead zone": ["rig.force_sensor.dead_zone=12", "rig.force_sensor.noise_std=2.7"],
    "fast": ["rig.control_period=0.00025", "contact.stiffness=[1e7]"],
    "slow": ["rig.control_period=0.02", "contact.stiffness=[10]", "approach.velocity=0.0001"],
    "late in jumps": ["rig.command_hold=zoh", "rig.command_latency=1"],
    "at once": ["rig.command_hold=zoh", *IDEAL, "rig.force_sensor.delay=0"],
    "light": ["bodies.equivalent_mass=0.01", "approach.velocity=3"],
}
WORDS = {value for name, value in vars(known).items() if name.isupper()}


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def commands(name, signals, gains, constants):
    """Return the force commands, (ticks, *batch); runs start where `age` is 0."""
    law = COMPENSATORS[name]
    prepared = law.prepare(gains, constants)

    def tick(state, now):
        index, signals = now
        begins = (signals.age == 0) & (index > RING)
        state = law.restart(gains, state, begins, begins)
        command, state = law.step(prepared, state, signals, index)
        return state, command

    ticks = jnp.arange(signals.age.shape[0], dtype=jnp.int32) + RING
    return jax.lax.scan(tick, law.init(gains, constants, RING), (ticks, signals))[1]


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def derivative(name, signals, gains, constants, along_signals, along_gains):
    """Return the derivative of the commands along a direction of the four readings and of the gains."""

    def of(moved, gains):
        return commands.__wrapped__(name, Signals(*moved, signals.age), gains, constants)

    return jax.jvp(of, (signals[:4], gains), (along_signals, along_gains))[1]


def readings(shape=(), clearance=math.inf):
    """Return the signals, each (ticks, *shape), of a contact with both surfaces, and the known constants.

    The measured force and position lag the sinusoidal motion.
    """
    size = 1 + 0.1 * np.arange(math.prod(shape)).reshape(shape)
    time = PERIOD * np.arange(TICKS).reshape(-1, *(1 for _ in shape))

    def motion(late):
        return 3e-4 * size * np.sin(40 * (time - late) - 0.3)

    late = motion(0.0091)
    far = np.minimum(late + clearance, 0.0)
    force = 1.2e5 * np.where(late > 0, late, far)
    velocity = 40 * 3e-4 * size * np.cos(40 * time - 0.3)
    age = np.broadcast_to((np.arange(TICKS) % 120).reshape(time.shape), velocity.shape)
    signals = Signals(force, motion(0.0), velocity, motion(0.0063), age.astype(np.int32))
    constants = KnownConstants(np.full(shape, PERIOD), np.full(shape, clearance))
    return jax.tree.map(jnp.asarray, (signals, constants))


def some_gains(name, shape=()):
    """Return nonzero gains that are equal in every lane."""
    return {gain: jnp.full(shape, entry["value"]) for gain, entry in GAINS[name].items()}


@pytest.mark.parametrize("name", LAWS)
def test_compensator_that_reads_position_declares_this(name):
    signals, constants = readings()
    blind = signals._replace(position_measured=jnp.full_like(signals.position_measured, jnp.nan))
    seeing, unseeing = (
        commands(name, given_signals, some_gains(name), constants) for given_signals in (signals, blind)
    )
    assert np.array_equal(seeing, unseeing) == (not COMPENSATORS[name].reads_position)


def on_the_rig(name, signals):
    """Return the runtime's commands for the readings of one lane."""
    gains = {gain: entry["value"] for gain, entry in GAINS[name].items()}
    controller = ON_THE_RIG[name](gains, PERIOD, GAP)
    result = []
    for *row, age in zip(*(np.asarray(leaf).tolist() for leaf in signals), strict=True):
        if age == 0:
            controller.next_contact()
        result.append(controller.step(*row))
    return np.array(result)


def test_every_compensator_exists_in_jax_and_runtime():
    assert set(ON_THE_RIG) == set(LAWS)
    for name, law in COMPENSATORS.items():
        assert law.name == name
        assert {g.name: g.unit for g in law.gains} == {g: s.unit for g, s in ON_THE_RIG[name].gains.items()}
        assert set(law.knows) <= WORDS


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("hostile", HOSTILE)
def test_nominal_gains_lie_within_bounds_of_runtime(name, hostile):
    mechanism = load("rig-300kg", HOSTILE[hostile]).mechanism
    for gain in COMPENSATORS[name].gains:
        lower, nominal, upper = (bound(mechanism) for bound in (gain.lower, gain.nominal, gain.upper))
        assert lower <= nominal <= upper and lower < upper and math.isfinite(upper), (gain.name, nominal)
        assert all(ON_THE_RIG[name].gains[gain.name].admits(bound) for bound in (lower, nominal, upper))
        assert lower > 0 or not gain.logarithmic
        assert gain.neutral is None or lower <= gain.neutral <= upper


@pytest.mark.parametrize("name", LAWS)
def test_jax_and_runtime_compensators_agree_for_contacts_and_for_noise(name):
    signals, constants = readings((), GAP)
    rng = np.random.default_rng(1)
    noise = Signals(*(leaf * rng.standard_normal(TICKS) for leaf in signals[:4]), signals.age)
    for case_signals in (signals, noise):
        runtime_commands = on_the_rig(name, case_signals)
        expected = commands(name, case_signals, some_gains(name), constants)
        np.testing.assert_allclose(runtime_commands, expected, rtol=0, atol=1e-11 * np.ptp(runtime_commands))


@pytest.mark.parametrize("name", WITH_GAINS)
def test_runtime_rejects_bad_gains_with_one_line_message(name):
    for gain, specification in ON_THE_RIG[name].gains.items():
        below = math.nextafter(specification.lowest, -math.inf)
        above = math.nextafter(specification.highest, math.inf)
        for value in (10**400, None, "1", True, below, above):
            document = gain_document(name)
            document["gains"][gain] |= {"value": value, "lower": -1e300, "upper": 1e300}
            with pytest.raises(GainFileError) as caught:
                Controller.from_dict(sign(document))
            assert f"gains.{gain}" in str(caught.value) and "\n" not in str(caught.value)
    document = gain_document(name)
    document["gains"].popitem()
    with pytest.raises(GainFileError, match=r"^[^\n]*gains[^\n]*$"):
        Controller.from_dict(sign(document))


@pytest.mark.parametrize("name", ON_THE_FORCE)
def test_compensator_gain_derivatives_match_finite_differences(name):
    signals, constants = readings((), GAP)
    # Add a sensor bias: some compensators estimate it.
    signals = signals._replace(force_measured=signals.force_measured + 0.3)
    gains = some_gains(name)
    still = tuple(jnp.zeros_like(leaf) for leaf in signals[:4])
    for gain, value in gains.items():
        along = {other: jnp.asarray(float(other == gain)) for other in gains}
        result = derivative(name, signals, gains, constants, still, along)
        # Between larger steps, the impulse ledger switches; smaller steps increase rounding errors.
        step = 2e-5 * value
        moved = [
            commands(name, signals, {**gains, gain: value + times * step}, constants)
            for times in (-2, -1, 1, 2)
        ]
        expected = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * step)
        scale = float(jnp.max(jnp.abs(expected)))
        assert scale > 0, f"{gain} does nothing"
        np.testing.assert_allclose(result, expected, rtol=0, atol=2e-6 * scale, err_msg=gain)


@pytest.mark.parametrize("name", LAWS)
def test_compensator_derivatives_are_finite_at_rest_and_without_force(name):
    signals, constants = readings((), GAP)
    gains = some_gains(name)
    nothing = signals._replace(**{leaf: jnp.zeros(TICKS) for leaf in signals._fields[:4]})
    for case_signals in (signals, nothing, nothing._replace(force_measured=signals.force_measured)):
        ones = jax.tree.map(jnp.ones_like, (case_signals[:4], gains))
        assert jnp.all(jnp.isfinite(derivative(name, case_signals, gains, constants, *ones)))


@pytest.mark.parametrize("name", LAWS)
def test_compensator_outputs_of_batch_elements_are_independent_for_any_batch_shape(name):
    signals, constants = readings((2, 3), GAP)
    together = commands(name, signals, some_gains(name, (2, 3)), constants)
    row = jax.tree.map(lambda leaf: leaf[..., 1, :], (signals, constants))
    in_a_row = commands(name, row[0], some_gains(name), row[1])
    lane = jax.tree.map(lambda leaf: leaf[..., 2], row)
    alone = commands(name, lane[0], some_gains(name), lane[1])
    assert together.shape == (TICKS, 2, 3) and in_a_row.shape == (TICKS, 3) and alone.shape == (TICKS,)
    scale = float(jnp.max(jnp.abs(alone)))
    np.testing.assert_allclose(together[:, 1, 2], alone, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(in_a_row[:, 2], alone, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("name", LAWS)
def test_compensator_output_is_float32_for_float32_inputs(name):
    lowered = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf,
        (*readings((), GAP), some_gains(name)),
    )
    signals, constants, gains = lowered
    of_law = functools.partial(commands.__wrapped__, name)
    assert jax.eval_shape(of_law, signals, gains, constants).dtype == jnp.float32


@pytest.mark.parametrize("name", LAWS)
def test_compensator_is_mirror_symmetric_between_surfaces(name):
    signals, _ = readings((), GAP)
    mirrored = Signals(
        -signals.force_measured,
        -GAP - signals.position_desired,
        -signals.velocity_desired,
        -GAP - signals.position_measured,
        signals.age,
    )
    result, expected = on_the_rig(name, mirrored), -on_the_rig(name, signals)
    assert np.min(expected) < 0 < np.max(expected)
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)))


@pytest.mark.parametrize("name", LAWS)
def test_compensator_state_is_cleared_when_a_run_starts(name):
    """The next contact keeps only identified parameters; a reset clears all."""
    law, gains = COMPENSATORS[name], some_gains(name)
    signals, constants = readings((), GAP)
    first = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[60]), signals)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def restarted(begins, fresh):
        prepared, ticks = law.prepare(gains, constants), jnp.arange(4, dtype=jnp.int32)
        start = law.init(gains, constants, RING)
        used, _ = jax.lax.scan(
            lambda state, tick: (law.step(prepared, state, first, tick)[1], None), start, ticks
        )
        return used, law.restart(gains, used, begins, fresh)

    for fresh in (False, True):
        used, goes_on = restarted(np.False_, np.bool_(fresh))
        jax.tree.map(np.testing.assert_array_equal, goes_on, used)
    rows = [row for row in zip(*(np.asarray(leaf).tolist() for leaf in signals[:4]), strict=True)]
    values = {gain: entry["value"] for gain, entry in GAINS[name].items()}
    controllers = [ON_THE_RIG[name](values, PERIOD, GAP) for _ in range(3)]
    for row in rows:
        controllers[0].step(*row)
        controllers[1].step(*row)
    controllers[0].reset()
    controllers[1].next_contact()
    if law.identified(used) is not None or law.estimates_delay:
        del controllers[1]
    for row in rows:
        assert len({controller.step(*row) for controller in controllers}) == 1


@pytest.mark.parametrize("name", LAWS)
def test_compensator_noise_amplification_matches_prediction(name):
    ticks, gains = 40_000, {gain: entry["value"] for gain, entry in GAINS[name].items()}
    law = COMPENSATORS[name]
    constants = KnownConstants(jnp.asarray(PERIOD), jnp.asarray(math.inf))
    predicted = float(law.noise_amplification(some_gains(name), constants))
    controller = ON_THE_RIG[name](gains, PERIOD, math.inf)
    noise = np.random.default_rng(5).standard_normal(ticks)
    result = [controller.step(120.0 + value, 1e-3, 0.0, 1e-3) for value in noise.tolist()]
    assert np.std(result[1000:]) == pytest.approx(predicted * np.std(noise[1000:]), rel=0.02)


@pytest.mark.parametrize("depth", [1.0, 1e4, 1e9])
def test_weakly_hardening_contact_has_peak_force_of_linear_contact(depth):
    """Numerical cancellation must not give a peak force of 0."""
    linear = load("claw-350kg", ["contact.damping=[0.0]"]).mechanism
    hardening = load(
        "claw-350kg", ['contact.law="hardening"', "contact.damping=[0.0]", f"contact.reference_depth={depth}"]
    ).mechanism
    assert known.peak_force(hardening) == pytest.approx(known.peak_force(linear), rel=1e-5)
