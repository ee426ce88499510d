"""`over_lanes` against `jax.vmap`, lane by lane."""

import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxnav.core.lanes import over_lanes as door
from jaxnav.core.lanes import rules
from jaxnav.core.lanes.over_lanes import compiler_options, lanes_first, lanes_last, over_lanes
from jaxnav.core.linalg.small_matrices import cho_solve, cholesky, sandwich

LANES = 37


def drawn(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=(*shape, LANES))


def same(fn, *args, rtol=1e-12, block=8):
    """Both evaluations agree, in the process's precision; the lane-wise one is returned."""
    args = jax.tree.map(jnp.asarray, args)
    mapped = jax.jit(over_lanes(fn, block), compiler_options=compiler_options())(*args)
    expected = jax.jit(jax.vmap(fn, in_axes=-1, out_axes=-1))(*args)
    assert jax.tree.structure(mapped) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(mapped), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)
    return mapped


def spd(A):
    return A @ A.T + jnp.eye(A.shape[0])


SHAPES = {
    "matrices": lambda A: cho_solve(cholesky(spd(A)), sandwich(A, spd(A))),
    "products": lambda A: (jnp.einsum("ij,kj->ik", A, A), A @ A[0], A[0] @ A[1], A @ jnp.eye(4)),
    "long product": lambda A: jnp.tile(A, (1, 12)) @ jnp.tile(A, (12, 1)),
    "batched products": lambda A: (jnp.einsum("ijk,lkj->jil", jnp.stack([A, A.T]), A[None]),
                                   jnp.stack([A, A.T]) @ jnp.stack([A.T, A])),
    "reductions": lambda A: (A.sum(), A.sum(0), A.max(1), A.min(), (A > 0).all(1), (A > 1).any()),
    "long reductions": lambda A: jnp.sum(A[:, :, None, None] * A[None, None], axis=(0, 2)),
    "running": lambda A: (jnp.cumsum(A, 0), jnp.cumprod(A, 1), jnp.cumsum(A[::-1], axis=0)),
    "diagonal": lambda A: (jnp.diagonal(A), jnp.diag(A[0]), jnp.trace(A)),
    "indexing": lambda A: (A[1], A[:, ::2], A[jnp.array([3, 0]), jnp.array([1, 2])], A[::-1]),
    "setting": lambda A: A.at[1, 2].set(7.0).at[0].set(A[1]).at[:2, :2].set(A[2:, 2:]),
    "own place": lambda A: (A[jnp.argmax(A[0])], A[:, jnp.argmin(A[1])], A[jnp.argsort(A[0])]),
    "orders": lambda A: (jnp.sort(A, 0), jnp.argsort(A, axis=1), lax.top_k(A[0], 2)),
    "equal ones": lambda A: (jnp.argsort(jnp.round(A)), lax.top_k(jnp.round(A[1]), 3)),
    "joined": lambda A: (jnp.concatenate([A, A * 2]), jnp.stack([A, A], 2), jnp.pad(A, 1)),
    "reshaped": lambda A: (A.reshape(2, 8).T, jnp.split(A, 2), jnp.repeat(A, 2, axis=0), A[None]),
    "clipped": lambda A: (jnp.clip(A, -1, 1), jnp.where(A[0, 0] > 0, A, 2.0), lax.clamp(0., A, 1.)),
    "functions": lambda A: (jnp.sin(A), jnp.exp(A), jnp.arctan2(A, A.T), jnp.sqrt(jnp.abs(A)),
                            lax.erf_inv(jnp.tanh(A)), A**3, jax.scipy.special.erfc(A)),
    "inverse": lambda A: jnp.linalg.inv(spd(A)),  # by vmap's own rule
    "constants": lambda A: (A * 0 + jnp.arange(4.0)[None], jnp.eye(3), 2 * jnp.ones(2)),
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_small_arrays(name):
    same(SHAPES[name], drawn(4, 4))


def test_what_is_not_a_number_comes_last():
    keys = drawn(5)
    keys[1, ::3] = np.nan
    keys[3] = np.where(np.arange(LANES) % 2, 0.0, -0.0)
    keys[4] = 0.0
    same(lambda k: (jnp.argsort(k), jnp.argmax(k), jnp.argmin(k)), keys)


def test_atan2_in_float32():
    rng = np.random.default_rng(1)
    y, x = rng.normal(size=(2, 4000)).astype(np.float32)
    y[:6], x[:6] = [0, 0.0, -0.0, 1, -1, np.nan], [1, -1, -1, 0, 0, 1]
    result = jax.jit(over_lanes(jnp.arctan2))(y, x)
    assert result.dtype == jnp.float32
    expected = np.arctan2(y.astype(float), x.astype(float))
    np.testing.assert_allclose(result, expected, rtol=3e-7)


def newton(x):
    """The square root of |x| + 1, by as many steps as it takes."""
    target = jnp.abs(x) + 1

    def step(carry):
        y, count = carry
        return (y + target / y) / 2, count + 1

    return lax.while_loop(lambda c: jnp.abs(c[0] ** 2 - target) > 1e-9, step, (target, 0))


def test_every_lane_s_loop_ends_when_it_would_alone():
    root, steps = same(newton, 100 * drawn())
    np.testing.assert_allclose(root**2, np.abs(100 * drawn()) + 1, rtol=1e-9)
    assert len(np.unique(steps)) > 2


def wave(x):
    return jnp.sin(x) * jnp.exp(-x) + jnp.sqrt(1 + x * x)


SMALL_LOOPS = {
    "once": lambda x: lax.scan(lambda c, _: (wave(c), None), x, length=1)[0],
    "thrice": lambda x: lax.scan(lambda c, _: (wave(c), c), x, length=3),
    "while": lambda x: lax.while_loop(
        lambda s: s[0] < 5, lambda s: (s[0] + abs(wave(s[1])), wave(s[1])), (x, x)
    ),
    "cond": lambda x: lax.cond(x > 0, wave, lambda c: 2 * wave(c + 1), x),
    "both": lambda x: lax.fori_loop(
        0, 3, lambda _, c: lax.cond(c > 1, wave, lambda d: 2 * wave(d + 1), c), x
    ),
}


@pytest.mark.parametrize("name", SMALL_LOOPS)
@pytest.mark.parametrize("lanes", [1, 8, 32, 64])
def test_a_small_loop_compiles(name, lanes):
    """XLA makes one kernel of it, in which it can't compile a barrier."""
    same(SMALL_LOOPS[name], np.linspace(-1, 1, lanes))


def test_loops_of_a_batch_inside_a_lane():
    """Each ends by itself, also in a lane whose others go on."""
    same(jax.vmap(newton), 100 * drawn(3))


@pytest.mark.parametrize("lanes", [33, 64, 100])
def test_loops_run_in_strips(lanes):
    """Each is one kernel, which ends with its own slowest lane; the last repeats some lanes."""

    def looping(x, floor):
        def step(carry):
            y, total, count = carry
            root, steps = newton(y + floor)
            both = jnp.stack([root, y]) / 3
            return both[0], total + jnp.outer(both, both)[0, 1], count + steps

        return lax.while_loop(lambda c: c[0] > 1, step, (jnp.abs(x), 0 * x, 0))

    x, floor = 100 * jnp.asarray(np.resize(drawn(), lanes)), jnp.asarray(np.resize(drawn(), lanes))
    mapped = jax.jit(over_lanes(looping), compiler_options=compiler_options())
    assert "xla_cpu_small_call" in mapped.lower(x, floor).as_text()
    straight = mapped(x, floor)
    for a, b in zip(
        jax.tree.leaves(straight), jax.tree.leaves(jax.vmap(looping)(x, floor)), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    order = np.random.default_rng(4).permutation(lanes)
    for a, b in zip(
        jax.tree.leaves(straight), jax.tree.leaves(mapped(x[order], floor[order])), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(a)[order], b)


def branching(which, A):
    def first(A):
        return A @ A, newton(A[0, 0])[1]

    def second(A):
        return sandwich(A, spd(A)) + offset, jnp.asarray(0)

    def third(A):
        return lax.cond(A[0, 0] > 0, lambda: A, lambda: -A), jnp.asarray(-1)

    return lax.switch(which, [first, second, third], A)


offset = np.arange(16.0).reshape(4, 4)


@pytest.mark.parametrize("which", [[0, 1, 2], [1], [2, 2, 2, 0]])
@pytest.mark.parametrize("block", [1, 5, 8, 64])
def test_every_lane_takes_its_own_branch(which, block):
    """Sorted into blocks, the last of which is not full; a branch may be nobody's."""
    same(branching, np.resize(which, LANES), drawn(4, 4), block=block)


def test_out_of_range_takes_the_nearest_branch():
    same(branching, np.arange(LANES) - 5, drawn(4, 4))


def test_a_branch_costs_what_its_lanes_cost():
    """Blocks that are run, counted by the loops in them."""
    seen = []

    def costly(x):
        jax.debug.callback(lambda: seen.append(1))
        return x * 2

    fn = over_lanes(lambda i, x: lax.switch(i, [lambda x: x, costly], x), block=8)
    index = (np.arange(LANES) < 9).astype(int)
    out = jax.jit(fn)(index, jnp.ones((3, LANES)))
    jax.effects_barrier()
    assert len(seen) == 2
    np.testing.assert_array_equal(out[0], 1 + index)


def test_inside_scan_and_around_it():
    def walk(x, steps):
        return lax.scan(lambda c, s: (branching(1, c * 0.1)[0] + s, c[0]), x, steps)

    same(walk, drawn(4, 4), drawn(5, seed=1))

    @jax.jit
    def outer(x):
        step = over_lanes(lambda c: branching(1, c * 0.1)[0])
        return lax.scan(lambda c, _: (step(c), None), x, length=3)[0]

    expected = jnp.asarray(drawn(4, 4))
    for _ in range(3):
        expected = jax.vmap(lambda c: branching(1, c * 0.1)[0], in_axes=-1, out_axes=-1)(expected)
    np.testing.assert_allclose(outer(drawn(4, 4)), expected, rtol=1e-12)


def test_random_numbers():
    keys = jax.random.split(jax.random.key(3), LANES)

    def draw(key):
        a, b = jax.random.split(jax.random.fold_in(key, 2))
        return jax.random.normal(a, (3, 2)), jax.random.uniform(b)

    same(draw, keys)


def test_a_lane_does_not_depend_on_the_others():
    """Bit for bit, wherever it stands."""
    which, A = np.resize([0, 1, 2, 1], 64), jnp.asarray(np.resize(drawn(4, 4), (4, 4, 64)))
    fn = jax.jit(over_lanes(branching, 16), compiler_options=compiler_options())
    straight, order = fn(which, A), np.random.default_rng(4).permutation(64)
    shuffled = fn(which[order], A[..., order])
    for a, b in zip(straight, shuffled, strict=True):
        np.testing.assert_array_equal(np.asarray(a)[..., order], b)


def test_derivatives_are_those_of_vmap():
    A, weight = jnp.asarray(drawn(4, 4)), jnp.asarray(drawn(4, 4, seed=2))
    which = jnp.resize(jnp.asarray([1, 2]), LANES)

    def total(map_, A, scale):
        out, _ = map_(lambda i, A: branching(i, scale * A))(which, A)
        return jnp.sum(weight * out)

    def ours(A, scale):
        return total(over_lanes, A, scale)

    def theirs(A, scale):
        return total(lambda fn: jax.vmap(fn, in_axes=-1, out_axes=-1), A, scale)

    for derive in (jax.grad, jax.jacfwd, jax.jacrev):
        for argument in (0, 1):
            one, other = (jax.jit(derive(f, argument))(A, 1.5) for f in (ours, theirs))
            assert np.all(np.isfinite(one))
            np.testing.assert_allclose(one, other, rtol=1e-10)
    mapped = jax.jit(jax.vmap(jax.grad(ours, 1), in_axes=(None, 0)))(A, jnp.asarray([1.0, 1.5]))
    np.testing.assert_allclose(mapped[1], jax.grad(theirs, 1)(A, 1.5), rtol=1e-10)


def test_nothing_is_computed_twice_or_for_nobody():
    """Not even in another branch's output; XLA would find it only after minutes, or never."""
    A = jnp.asarray(drawn(4, 4))

    def sines(fn):
        return jax.jit(over_lanes(fn)).lower(A).as_text().count("stablehlo.sine")

    def chosen(A):
        return lax.cond(A[0, 0] > 0, lambda: (A, jnp.sin(A)), lambda: (-A, jnp.sin(2 * A)))

    assert sines(chosen) == 2
    assert sines(lambda A: chosen(A)[0]) == 0
    assert sines(lambda A: jnp.sin(A) + jax.jit(jnp.sin)(A)) == 1
    assert sines(lambda A: jnp.sin(A) + jnp.sin(A + 0.0)) == 2
    both = same(lambda A: (A + 1.0, A + 2.0, A[0] * 2.0, A[1] * 2.0, A + 1), A)
    np.testing.assert_array_equal(both[0], both[4])


def test_axes_are_moved_there_and_back():
    tree = {"a": jnp.arange(12.0).reshape(3, 2, 2), "b": jnp.arange(3)}
    last = lanes_last(tree)
    assert last["a"].shape == (2, 2, 3)
    back = lanes_first(last)
    jax.tree.map(np.testing.assert_array_equal, back, tree)


def _without_metadata(monkeypatch):
    """A JAX that lacks a function which the folder imports."""
    monkeypatch.delattr("jax.experimental.xla_metadata.set_xla_metadata")
    for name in list(sys.modules):
        if name.startswith("jaxnav.core.lanes.") and name != door.__name__:
            monkeypatch.delitem(sys.modules, name)


def _with_renamed_parameters(monkeypatch):
    """A JAX whose `dot_general` has parameters of other names."""
    rule = rules.RULES["dot_general"]
    monkeypatch.setitem(
        rules.RULES,
        "dot_general",
        lambda args, params, lanes: rule(args, {f"{k}_2": v for k, v in params.items()}, lanes),
    )


@pytest.mark.parametrize("differ", [_without_metadata, _with_renamed_parameters])
def test_another_jax_gives_the_results_of_vmap_with_one_warning(monkeypatch, differ):
    door._warn.cache_clear()
    which, A = np.resize([0, 1, 2], LANES), jnp.asarray(drawn(4, 4))
    differ(monkeypatch)
    with pytest.warns(UserWarning, match=r"does not fit jax .*: vmap takes its place"):
        out = jax.jit(over_lanes(branching))(which, A)
    expected = jax.jit(jax.vmap(branching, in_axes=-1, out_axes=-1))(which, A)
    jax.tree.map(np.testing.assert_array_equal, out, expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(over_lanes(branching))(which, A)
    door._warn.cache_clear()


def test_an_error_of_the_function_itself_stays_an_error():
    def wrong(x):
        raise KeyError("of the caller")

    with pytest.raises(KeyError, match="of the caller"):
        over_lanes(wrong)(jnp.ones(LANES))
