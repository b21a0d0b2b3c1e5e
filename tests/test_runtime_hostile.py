"""Hostile input of a controller: commands stay finite and within limits, and memory does not grow."""

import math
import random
import tracemalloc
from itertools import pairwise

import pytest
from guarded import PERIOD, limited
from hypothesis import given
from hypothesis import strategies as st

hostile = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from(
    [0.0, -0.0, 1e308, 5e-324, math.nan]
)
calls = st.lists(
    st.tuples(
        st.sampled_from(["step", "timed", "position", "tare", "next", "reset", "stop", "release"]),
        st.tuples(hostile, hostile, hostile, hostile, hostile),
    ),
    max_size=60,
)


@given(calls=calls, name=st.sampled_from(["none", "phase_lead", "response_error"]))
def test_controller_outputs_are_finite_and_within_limits_for_any_input(calls, name):
    controller = limited(name)
    force, sent = 0.0, None
    for call, values in calls:
        if call in ("step", "timed"):
            new = controller.step(*values[:4], values[4] if call == "timed" else None)
            assert abs(new) <= 1000.0 and abs(new - force) <= 100.0 * (1 + 1e-12)
            force = new
        elif call == "position":
            new = controller.position_command(*values[:3])
            if sent is not None:
                # Commands outside the stroke are allowed only if the drives were there at the start, and
                # never further out.
                assert min(-0.04, sent) <= new <= max(0.008, sent)
                assert abs(new - sent) <= 2e-5 * (1 + 1e-9) + 1e-14
            sent = new
        elif call == "tare":
            controller.tare(values[0])
        elif call == "next":
            if not controller.tripped:
                sent = None
            controller.next_contact()
        elif call == "reset":
            controller.reset()
        else:
            controller.emergency_stop(call == "stop")
        assert controller.tripped is (controller.status != "ok")
        assert "\n" not in controller.status


@pytest.mark.parametrize("name", ["none", "phase_lead", "response_error"])
def test_controller_memory_does_not_grow(name):
    controller = limited(name)
    rng = random.Random(1)
    ticks = [(rng.gauss(0, 1), -0.02 + 1e-9 * n, 5e-3, -0.02 + 1e-9 * n) for n in range(1000)]

    def run(first: int) -> None:
        for n, tick in enumerate(ticks, start=first):
            controller.step(*tick, n * PERIOD)
            controller.position_command(*tick[1:3], 0.0)

    run(0)
    tracemalloc.start()
    try:
        run(1000)
        sizes = [tracemalloc.get_traced_memory()[0]]
        for n in range(2, 6):
            run(1000 * n)
            sizes.append(tracemalloc.get_traced_memory()[0])
        # A controller that keeps memory grows in every run; the test runner's threads do so now and then.
        assert min(after - before for before, after in pairwise(sizes)) < 500
    finally:
        tracemalloc.stop()
    assert controller.status == "ok"
