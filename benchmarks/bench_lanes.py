"""Time every rule of `over_lanes` for a primitive against `vmap`'s: a rule that falls off shows.

    python benchmarks/bench_lanes.py              # the table of README-lanes.md
    pytest benchmarks/bench_lanes.py --benchmark-enable --benchmark-only

A row is one primitive, alone, with its rule and without. It fails where nothing asks for the rule
any longer, as under a JAX that names the primitive anew. Elementwise primitives have none.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from pytest_benchmark.fixture import BenchmarkFixture

from jaxnav.core.lanes.over_lanes import compiler_options, over_lanes
from jaxnav.core.lanes.rules import RULES

LANES, ROUNDS = 4096, 40
# Of a lane's matrix (6, 6) and one index, 0 to 5.
ROWS: dict[str, Callable[[jax.Array, jax.Array], object]] = {
    "broadcast_in_dim": lambda A, k: jnp.broadcast_to(A, (3, 6, 6)),
    "reshape": lambda A, k: A.reshape(4, 9),
    "squeeze": lambda A, k: lax.squeeze(A[:1], (0,)),
    "transpose": lambda A, k: A.T,
    "slice": lambda A, k: A[1:4],
    "concatenate": lambda A, k: jnp.concatenate([A, A]),
    "stack": lambda A, k: jnp.stack([A, A], 1),
    "split": lambda A, k: jnp.split(A, 2),
    "pad": lambda A, k: jnp.pad(A, 1),
    "rev": lambda A, k: lax.rev(A, (0,)),
    "reduce_sum": lambda A, k: A.sum(0),
    "reduce_max": lambda A, k: A.max(0),
    "reduce_min": lambda A, k: A.min(0),
    "reduce_and": lambda A, k: (A > 0).all(0),
    "reduce_or": lambda A, k: (A > 0).any(0),
    "argmax": lambda A, k: jnp.argmax(A, 0),
    "argmin": lambda A, k: jnp.argmin(A, 0),
    "dot_general": lambda A, k: A @ A,
    "cumsum": lambda A, k: jnp.cumsum(A, 0),
    "cumprod": lambda A, k: jnp.cumprod(A, 0),
    "atan2": lambda A, k: jnp.arctan2(A, A.T),
    "gather": lambda A, k: A[:, jnp.stack([k, k])],
    "dynamic_slice": lambda A, k: lax.dynamic_slice_in_dim(A, k, 1),
    "scatter": lambda A, k: A.at[2].set(0.0),
    "sort": lambda A, k: jnp.sort(A, 0),
    "top_k": lambda A, k: lax.top_k(A[0], 2),
}
# They return what they are given.
FREE = {"stop_gradient", "nondifferentiable_backward", "nonbatchable", "unvmap_any"}


def lowered(name: str) -> jax.stages.Lowered:
    """The row's function for all lanes, under the rules of the moment."""
    A, k = jax.ShapeDtypeStruct((6, 6, LANES), "float32"), jax.ShapeDtypeStruct((LANES,), "int32")
    return jax.jit(over_lanes(ROWS[name]), compiler_options=compiler_options()).lower(A, k)


def both_ways(name: str) -> tuple[jax.stages.Lowered, jax.stages.Lowered]:
    """With the rule of a primitive and without it.

    Raises:
        AssertionError: the row does not ask for the rule.
    """
    rule, answers = RULES[name], []

    def noted(*args: Any) -> Any:
        answers.append(rule(*args))
        return answers[-1]

    try:
        RULES[name] = noted
        with_rule = lowered(name)
        del RULES[name]
        without = lowered(name)
    finally:
        RULES[name] = rule
    assert answers, f"nothing asks for the rule of {name}"
    assert None not in answers, f"the rule of {name} falls back to vmap's"
    return with_rule, without


def run_of(program: jax.stages.Lowered) -> Callable[[], object]:
    """A call of the compiled program."""
    rng, compiled = np.random.default_rng(0), program.compile()
    A = jnp.asarray(rng.normal(size=(6, 6, LANES)), "float32")
    k = jnp.asarray(rng.integers(0, 6, LANES), "int32")
    return lambda: jax.block_until_ready(compiled(A, k))


def test_every_rule_has_a_row() -> None:
    assert set(ROWS) | FREE == set(RULES)


@pytest.mark.parametrize("name", ROWS)
def test_rule(benchmark: BenchmarkFixture, name: str) -> None:
    program, _ = both_ways(name)
    benchmark(run_of(program))


def main() -> None:
    print(f"jax {jax.__version__}, {LANES} lanes of a matrix (6, 6), float32\n")
    print("| primitive | us with its rule | us by vmap's | ratio |")
    print("|---|---|---|---|")
    for name in ROWS:
        runs = [run_of(program) for program in both_ways(name)]
        spent_us: list[list[float]] = [[], []]
        for _ in range(ROUNDS):
            for run, these in zip(runs, spent_us, strict=True):
                started = time.perf_counter()
                run()
                these.append(1e6 * (time.perf_counter() - started))
        ours, theirs = map(float, np.median(spent_us, axis=1))
        print(f"| {name} | {ours:.0f} | {theirs:.0f} | {theirs / ours:.1f} |", flush=True)


if __name__ == "__main__":
    main()
