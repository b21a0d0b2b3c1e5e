"""C code of JAX programs: the compiled functions against JAX, on random and on extreme inputs."""

import ctypes
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxhil.simulation.jax_environment import jax_context
from tuning.bundle.fmu.archive import find_compiler
from tuning.bundle.jaxpr_c.functions import to_c
from tuning.bundle.jaxpr_c.values import UnsupportedProgram

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
HEADERS = "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n"
FLAGS = (
    "-std=c99",
    "-O1",
    "-fPIC",
    "-shared",
    "-ffp-contract=off",
    "-pedantic",
    "-Wall",
    "-Wextra",
    "-Werror",
)

EXTREMES = np.array([0.0, -0.0, 1.0, -1.5, 2.5, 0.3, -0.7, 1e300, -1e-300, 3e9, np.inf, -np.inf, np.nan])
FIRST, SECOND = (part.ravel() for part in np.meshgrid(EXTREMES, EXTREMES))
INTEGERS = np.array([0, 1, -1, 7, -8, 2**31 - 1, -(2**31), 33], np.int32)
LEFT, RIGHT = (part.ravel() for part in np.meshgrid(INTEGERS, INTEGERS))
TABLE = np.random.default_rng(0).normal(size=(4, 6))
NEAR_ONE = 1.0 - 10.0 ** -np.arange(1.0, 16.0)

# Programs by name, each a function of (FIRST, SECOND, LEFT, RIGHT, TABLE).
MOVEMENTS = {
    "clamped slice": lambda a, b, i, j, t: jnp.stack([
        lax.dynamic_slice(t, (i[n], j[n]), (2, 3)) for n in range(0, 64, 9)
    ]),
    "clamped update": lambda a, b, i, j, t: lax.dynamic_update_slice(t, t[:2, 1:3] + 1.0, (i[5], j[2])),
    "gather": lambda a, b, i, j, t: t[jnp.abs(i[:8]) % 4, jnp.abs(j[:8]) % 6],
    "gather outside": lambda a, b, i, j, t: t.at[i[:8]].get(mode="fill", fill_value=-3.0),
    "gather clipped": lambda a, b, i, j, t: t.at[:, i[:8]].get(mode="clip"),
    "strides": lambda a, b, i, j, t: t[::2, ::-1].T + 1.0,
    "transposition": lambda a, b, i, j, t: (t.T * 2.0).reshape(8, 3)[:, ::-1],
    "joined rows": lambda a, b, i, j, t: jnp.concatenate([t[1:3], t[:1] * 2.0, jnp.ones((2, 6))]),
    "long permutation": lambda a, b, i, j, t: jnp.concatenate([a, a[::-1], t.T.ravel()]) + 1.0,
    "broadcast": lambda a, b, i, j, t: t[:, None, :] * t[None, :, :] + jnp.arange(4.0)[:, None, None],
    "sums": lambda a, b, i, j, t: jnp.concatenate([t.sum(0), t.max(1), t.min(1), t.prod(0)]),
    "maximum of NaN": lambda a, b, i, j, t: jnp.stack([a.max(), a[:5].min(), jnp.sum(b[:3])]),
    "all and any": lambda a, b, i, j, t: jnp.concatenate([(t > 0).all(0), (t > 0).any(1)]),
    "product": lambda a, b, i, j, t: jnp.einsum("ij,kj->ki", t, t) @ t,
}  # fmt: skip
LOOPS = {
    "scan": lambda a, b, i, j, t: lax.scan(lambda c, row: (c * 0.5 + row, c.sum()), t[0], t),
    "reverse scan": lambda a, b, i, j, t: lax.scan(lambda c, x: (c + x[0], (c, x * c)), 1.0, t, reverse=True),
    "scan of scalars": lambda a, b, i, j, t: lax.scan(lambda c, x: (c * x, c), 1.0, t[:, 1]),
    "while": lambda a, b, i, j, t: lax.while_loop(
        lambda c: c[0].sum() < 50.0, lambda c: (c[0] * 1.5 + 1.0, c[1] + 1), (jnp.abs(t[0]), 0)
    ),
    "branches": lambda a, b, i, j, t: [
        lax.switch(i[n], [lambda x: x, lambda x: x * 2.0, lambda x: x[::-1] * 1.0], t[0])
        for n in (0, 1, 2, 3)
    ],
    "nested": lambda a, b, i, j, t: lax.fori_loop(
        0, 3, lambda k, c: lax.cond(k == 1, lambda c: c + t, lambda c: c * (2.0 + k), c), t
    ),
}
NUMBERS = {
    **{
        name: lambda a, b, i, j, t, function=function: function(a, b)
        for name, function in {
            "sum": lax.add, "difference": lax.sub, "product": lax.mul, "quotient": lax.div, "rest": lax.rem,
            "maximum": lax.max, "minimum": lax.min, "angle": lax.atan2, "less": lax.lt, "equal": lax.eq,
            "other": lax.ne, "at least": lax.ge,
        }.items()
    },
    **{
        function.__name__: lambda a, b, i, j, t, function=function: function(a)
        for function in (
            lax.neg, lax.abs, lax.sign, lax.floor, lax.ceil, lax.is_finite, lax.sqrt, lax.rsqrt, lax.sin,
            lax.cos, lax.exp, lax.log, lax.expm1, lax.log1p, lax.tanh, lax.square, lax.logistic, jnp.round,
        )
    },
    "powers": lambda a, b, i, j, t: jnp.stack([a**2, a**3, a**-2, a**5, jnp.abs(a) ** 0.5]),
    "away from zero": lambda a, b, i, j, t: lax.round(a, lax.RoundingMethod.AWAY_FROM_ZERO),
    "clamped": lambda a, b, i, j, t: lax.clamp(-0.5, a, 2.0),
    "selection": lambda a, b, i, j, t: jnp.where(a > b, a, b),
    "to integers": lambda a, b, i, j, t: [a.astype(kind) for kind in ("int32", "uint32", "int64", "bool")],
    "from integers": lambda a, b, i, j, t: [i.astype(kind) for kind in ("float64", "uint32", "bool")],
    "inverse erf": lambda a, b, i, j, t: lax.erf_inv(jnp.linspace(-1.0, 1.0, 41) * (1 + 0.0 * t[0, 0])),
    "inverse erf near 1": lambda a, b, i, j, t: lax.erf_inv(jnp.asarray(NEAR_ONE)),
    "integers": lambda a, b, i, j, t: [
        function(i, j)
        for function in (lax.add, lax.sub, lax.mul, lax.div, lax.rem, lax.max, lax.min, lax.bitwise_xor)
    ],
    "bits": lambda a, b, i, j, t: [
        function(i.astype("uint32"), j.astype("uint32"))
        for function in (lax.add, lax.mul, lax.shift_left, lax.shift_right_logical, lax.bitwise_and, lax.div)
    ],
    "signs": lambda a, b, i, j, t: [lax.abs(i), lax.neg(i), lax.sign(i), lax.bitwise_not(i)],
    "conditions": lambda a, b, i, j, t: [(a > 0) & (b > 0), (a > 0) | (b > 0), (a > 0) ^ (b > 0), ~(a > 0)],
}  # fmt: skip
# Relative tolerances larger than rounding: for arguments near 1, XLA's approximation loses digits.
TOLERANCES = {"inverse erf near 1": 1e-9}
ARGUMENTS = (FIRST, SECOND, LEFT, RIGHT, TABLE)


def compute_both(programs, folder):
    """Return the results of JAX and of C, for all programs in one function."""
    with jax_context():
        traced = jax.make_jaxpr(lambda *arguments: [program(*arguments) for program in programs.values()])
        function = jax.jit(lambda *arguments: [program(*arguments) for program in programs.values()])
        jaxpr, expected = traced(*ARGUMENTS), function(*ARGUMENTS)
        (folder / "programs.c").write_text(HEADERS + to_c({"programs": jaxpr}))
        command = [find_compiler(), *FLAGS, "-o", folder / "programs.so", folder / "programs.c", "-lm"]
        ran = subprocess.run([*map(str, command)], capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        flat = [np.asarray(leaf) for leaf in jax.tree.leaves(expected)]
    results = [np.empty_like(leaf) for leaf in flat]
    arrays = [np.ascontiguousarray(array) for array in ARGUMENTS] + results
    ctypes.CDLL(str(folder / "programs.so")).programs(
        *(ctypes.c_void_p(array.ctypes.data) for array in arrays)
    )
    structure = jax.tree.structure(expected)
    return dict(zip(programs, jax.tree.unflatten(structure, results), strict=True)), dict(
        zip(programs, jax.tree.unflatten(structure, flat), strict=True)
    )


def assert_equal(programs, folder):
    found, expected = compute_both(programs, folder)
    for name in programs:
        for mine, other in zip(jax.tree.leaves(found[name]), jax.tree.leaves(expected[name]), strict=True):
            tolerance = TOLERANCES.get(name, 1e-14)
            np.testing.assert_allclose(mine, other, rtol=tolerance, atol=1e-14, err_msg=name)
            is_zero = (mine == 0) & (other == 0)
            same = np.signbit(mine.astype(float)) == np.signbit(other.astype(float))
            assert np.all(same | ~is_zero), name


def test_c_code_moves_elements_and_repeats_functions_as_jax_does(tmp_path):
    assert_equal(MOVEMENTS | LOOPS, tmp_path)


@pytest.mark.slow
def test_c_code_computes_numbers_as_jax_does(tmp_path):
    assert_equal(NUMBERS, tmp_path)


def test_unknown_primitives_and_types_are_rejected_by_name():
    with jax_context():
        sorting = jax.make_jaxpr(jnp.sort)(TABLE)
        complex_numbers = jax.make_jaxpr(lambda x: x * x)(TABLE + 1j)
    with pytest.raises(UnsupportedProgram, match="primitive: found sort of float64"):
        to_c({"program": sorting})
    with pytest.raises(UnsupportedProgram, match="found complex128, expected one of float64"):
        to_c({"program": complex_numbers})


def test_equal_parts_of_a_program_are_printed_once():
    with jax_context():
        loop = lambda x: lax.fori_loop(0, 3, lambda _, y: y * x[0] + 1.0, x)  # noqa: E731
        jaxpr = jax.make_jaxpr(lambda x: loop(loop(x)))(TABLE[0])
    text = to_c({"program": jaxpr})
    assert text.count("static void part_") == 1 and text.count("part_1(") == 3
