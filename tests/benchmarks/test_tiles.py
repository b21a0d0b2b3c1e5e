"""Speed of rollouts for other tile sizes and vector widths, with bit-identical results.

Run with `pytest -m benchmark -s tests/benchmarks/test_tiles.py`.
"""

from functools import partial

import jax
import numpy as np
import pytest
from test_throughput import LANES, PROCESSOR, best, case, timed

from jaxhil.simulation import evaluation
from jaxhil.simulation.jax_environment import ROLLOUT_OPTIONS
from jaxhil.simulation.one_axis import ONE_AXIS, OneAxis

pytestmark = pytest.mark.benchmark
OURS = evaluation.TILE_SIZE, ROLLOUT_OPTIONS["xla_cpu_prefer_vector_width"]
OTHERS = [(32, 512), (128, 512), (256, 512), (64, 256)]


@pytest.mark.parametrize("compensator", ["none", "response_error"])
def test_default_tile_size_and_vector_width_are_the_fastest(compensator, monkeypatch, capsys):
    loop, gains, scenarios = case(compensator, LANES)
    runs, outcomes = [], []

    def use(options):
        monkeypatch.setattr(OneAxis, "compiler_options", options)

    def run(options, arguments):
        use(options)
        return ONE_AXIS.run_tiles(loop, *arguments)

    for tile, width in (OURS, *OTHERS):
        options = {**ROLLOUT_OPTIONS, "xla_cpu_prefer_vector_width": width}
        monkeypatch.setattr(evaluation, "TILE_SIZE", tile)
        use(options)
        outcomes.append(ONE_AXIS.evaluate(loop, gains, scenarios))
        batch = ONE_AXIS.place_batch(scenarios)
        arguments = *evaluation.place_gains(batch, gains), batch.scenarios
        runs.append(timed(partial(run, options, arguments)))
    ours, *others = best(*runs)
    rates = {own: ours / time for own, time in zip(OTHERS, others, strict=True)}
    with capsys.disabled():
        shown = ", ".join(f"{tile}/{width} {rate:.2f}" for (tile, width), rate in rates.items())
        print(f"\n{PROCESSOR}, {compensator}: speed of tile/vector width over {OURS}: {shown}")
    for other in outcomes[1:]:
        jax.tree.map(np.testing.assert_array_equal, other, outcomes[0])
    assert max(rates.values()) <= 1.03
