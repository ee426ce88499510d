"""A descent from its beginning to its end: its stopping, its result and its resumption."""

import io
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.experiments.tuning.descent import Noisy, Smooth
from jaxnav.experiments.tuning.fit import Problem, TuningFit, arrays_of, fit_of, take_step
from jaxnav.experiments.tuning.objective import Batch, NotFinite, Objective, where_not_finite

ITEMS = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))
ZERO = jnp.zeros(())


def cost(x, item, softness):
    """Five frames, each with a weight of its own."""
    return jnp.arange(1, 6) * (jnp.sum((x - item) ** 2) + softness)


OBJECTIVE = Objective(cost, prior_sigma=2.0)
BATCH = Batch(ITEMS, jnp.asarray(20.0))
BEGIN = jnp.asarray([2.0, -3.0, 1.0])


def minimum() -> np.ndarray:
    """Of OBJECTIVE, in closed form: items pull with weight 2 * 15 each, the prior with 1 / 4."""
    return 2 * 15 * np.asarray(ITEMS).sum(axis=0) / (2 * 15 * 4 + 0.25)


def losses_of(x, stage_x, stage) -> float:
    return float(np.sum((np.asarray(x) - minimum()) ** 2))


def problem(**changes) -> Problem:
    asked = {
        "optimiser": Smooth(OBJECTIVE, 1e-8, 1e-8),
        "batch": lambda x, stage, step: BATCH,
        "held_out": losses_of,
    }
    return Problem(**asked | changes)


def fitted(problem: Problem, x=BEGIN) -> TuningFit:
    fit = TuningFit.begin(x, problem)
    while not fit.over:
        fit = take_step(fit, problem)
    return fit


def test_an_objective_is_the_mean_over_frames_and_the_prior():
    x, softness = jnp.asarray([0.3, -0.5, 2.0]), jnp.asarray(0.7)
    total = sum(15 * (np.sum((np.asarray(x) - item) ** 2) + 0.7) for item in np.asarray(ITEMS))
    expected = (total + np.sum(np.asarray(x) ** 2) / 8) / 20
    assert float(OBJECTIVE(x, BATCH, softness)) == pytest.approx(expected, rel=1e-12)
    assert float(OBJECTIVE.total(x, ITEMS, softness)) == pytest.approx(total, rel=1e-12)
    slope = jax.grad(OBJECTIVE)(jnp.asarray(minimum()), BATCH, ZERO)
    np.testing.assert_allclose(slope, 0, atol=1e-12)
    assert Objective(cost).prior_sigma == pytest.approx(np.log(30))


_TWO_DEVICES = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from jaxnav.experiments.tuning.objective import Objective
objective = Objective(lambda x, item, softness: jnp.arange(3.0) * jnp.sum((x - item) ** 2))
total = jax.jit(jax.value_and_grad(objective.total))
x, zero = jnp.ones(2), jnp.zeros(())
for count in (4, 3):
    value, slope = total(x, jnp.arange(2.0 * count).reshape(count, 2), zero)
    print(len(jax.devices()), float(value), *map(float, slope))
"""


def test_two_devices_share_the_items():
    """As many as divide by two; others go to one."""
    flags = "--xla_force_host_platform_device_count=2"
    told = subprocess.run(
        [sys.executable, "-c", _TWO_DEVICES], capture_output=True, text=True, check=True,
        env=dict(os.environ, XLA_FLAGS=flags, JAX_PLATFORMS="cpu"),
    ).stdout.splitlines()  # fmt: skip
    for line, count in zip(told, (4, 3), strict=True):
        items = np.arange(2.0 * count).reshape(count, 2)
        expected = [2, 3 * np.sum((1 - items) ** 2), *(6 * (1 - items)).sum(axis=0)]
        np.testing.assert_allclose(list(map(float, line.split())), expected)


def test_it_converges():
    fit = fitted(problem())
    assert fit.ended == "converged"
    np.testing.assert_allclose(fit.best_x, minimum(), atol=1e-5)
    assert len(fit.history) == fit.step + 1
    np.testing.assert_allclose(fit.history[0][1:], [losses_of(BEGIN, None, 0), *BEGIN])
    for row in fit.history:
        assert row[1] == losses_of(row[2:], None, 0)
    assert fit.best_loss == min(row[1] for row in fit.history)


def test_it_makes_so_many_steps():
    fit = fitted(problem(steps=3))
    assert (fit.step, fit.ended) == (3, "3 steps are done")


def test_it_loses_its_patience():
    """What learns and does not help: the start is the best there is."""
    fit = fitted(problem(held_out=lambda x, *_: -losses_of(x, *_), patience=4))
    assert fit.ended == "no better on held-out drives"
    np.testing.assert_array_equal(fit.best_x, BEGIN)
    assert fit.best_loss == -losses_of(BEGIN, None, 0)
    assert fit.stale == 4
    assert fit.step <= 5


@pytest.mark.parametrize("when", [0, 2])
def test_a_held_out_loss_that_is_no_number_is_never_the_best(when):
    count = iter(range(100))

    def held_out(x, *_):
        return np.nan if next(count) == when else losses_of(x, *_)

    fit = fitted(problem(held_out=held_out))
    np.testing.assert_allclose(fit.best_x, minimum(), atol=1e-5)
    assert fit.best_loss < 1e-9


def test_stages_pose_the_problem_anew():
    """Each begins where the last one was best; what is asked is known by where it began."""
    asked = []

    def batch(x, stage, step):
        asked.append((stage, step, np.asarray(x)))
        return Batch(ITEMS + 0.1 * stage, BATCH.frames)

    def held_out(x, stage_x, stage):
        assert np.all(stage_x == next(a[2] for a in asked if a[0] == stage))
        return float(np.sum((np.asarray(x) - minimum() - 0.1 * stage) ** 2))

    fit = fitted(problem(batch=batch, held_out=held_out, stages=3))
    assert fit.ended == "converged"
    assert fit.stage == 2
    begun = {stage: x for stage, _, x in reversed(asked)}
    np.testing.assert_array_equal(begun[0], BEGIN)
    np.testing.assert_allclose(begun[1], minimum(), atol=1e-5)
    np.testing.assert_allclose(begun[2], minimum() + 0.1 * 120 / 120.25, atol=1e-3)
    np.testing.assert_array_equal(begun[2], fit.stage_x)
    steps = [step for stage, step, _ in asked if stage > 0]
    assert steps == sorted(steps)
    rows = np.array(fit.history)
    assert len(rows) == fit.step + 3
    begins = np.flatnonzero(np.isnan(rows[:, 0]))
    np.testing.assert_array_equal(rows[begins, 2:], [begun[stage] for stage in range(3)])
    # Where a stage begins and nothing has moved yet, the loss is that stage's already.
    expected = held_out(begun[2], fit.stage_x, 2)
    assert rows[begins[2], 1] == rows[begins[2] + 1, 1] == expected
    assert fit.best_loss == rows[begins[2] :, 1].min() < expected


def test_a_stage_that_changes_nothing_is_the_last():
    fit = fitted(problem(stages=9))
    assert fit.stage == 1
    assert fit.ended == "converged"


def broken_batch(bad):
    """A cost of no number in the steps that are named."""

    def batch(x, stage, step):
        return Batch(jnp.where(step in bad, jnp.nan, ITEMS), BATCH.frames)

    return batch


def test_a_gradient_that_is_not_finite_ends_it_where_nothing_will_change():
    fit = fitted(problem(batch=broken_batch({0})))
    assert (fit.step, fit.ended) == (1, "a gradient is not finite")
    assert len(fit.history) == 1
    np.testing.assert_array_equal(fit.best_x, BEGIN)


@jax.jit
def evaluate(x, batch, softness):
    return jax.value_and_grad(OBJECTIVE)(x, batch, softness)


NOISY = Noisy(evaluate, 0.2, steps=30)


def test_another_batch_may_be_better():
    asked = problem(optimiser=NOISY, steps=30, batch=broken_batch({2, 3, 7}), same_batch=False)
    fit = fitted(asked)
    assert fit.ended == "30 steps are done"
    assert len(fit.history) == 31 - 3
    assert fit.refused == 0
    assert fit.best_loss < losses_of(BEGIN, None, 0) / 4


@pytest.mark.parametrize(("steps", "patience"), [(30, 4), (4, 30)])
def test_but_not_for_ever(steps, patience):
    asked = problem(
        optimiser=NOISY, steps=steps, patience=patience, batch=broken_batch(range(99)),
        same_batch=False,
    )  # fmt: skip
    fit = fitted(asked)
    assert (fit.step, fit.ended) == (4, "a gradient is not finite")
    np.testing.assert_array_equal(fit.descent.x, BEGIN)


def saved(fit: TuningFit) -> dict[str, np.ndarray]:
    """By way of a file."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays_of(fit))
    with np.load(io.BytesIO(buffer.getvalue()), allow_pickle=False) as arrays:
        return dict(arrays)


def moved_by(shift) -> Batch:
    """In whatever precision is the default."""
    return Batch(jnp.asarray(np.asarray(ITEMS) + shift, float), jnp.asarray(20.0))


RESUMED = {
    "smooth": problem(stages=2, batch=lambda x, stage, step: moved_by(stage)),
    "noisy": problem(
        optimiser=NOISY,
        steps=12,
        batch=lambda x, stage, step: moved_by(0.1 * np.sin(7 * step)),
        same_batch=False,
    ),
}


@pytest.mark.parametrize("asked", RESUMED.values(), ids=RESUMED)
def test_what_goes_on_ends_at_the_same_bits(asked):
    """Interrupted after every single step, in float32 and float64."""
    for dtype in (np.float64, np.float32):
        with jax.enable_x64(dtype == np.float64):
            begin = jnp.asarray(BEGIN, dtype)
            whole, fit = fitted(asked, begin), TuningFit.begin(begin, asked)
            while not fit.over:
                fit = fit_of(saved(fit), TuningFit.begin(begin, asked))
                fit = take_step(fit, asked)
            fit = fit_of(saved(fit), TuningFit.begin(begin, asked))
        assert fit.best_x.dtype == dtype
        one, other = arrays_of(fit), arrays_of(whole)
        assert one.keys() == other.keys()
        for name in one:
            assert one[name].dtype == other[name].dtype
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)
        assert fit.ended == whole.ended != ""


def test_arrays_of_something_else_are_refused():
    asked = problem()
    fit = take_step(TuningFit.begin(BEGIN, asked), asked)
    arrays = arrays_of(fit)
    with pytest.raises(ValueError, match=r"\(3,\) float64 became \(2,\) float64"):
        fit_of(arrays_of(TuningFit.begin(BEGIN[:2], problem(held_out=lambda *_: 0.0))), fit)
    with pytest.raises(ValueError, match=r"float64 became .* float32"):
        fit_of(arrays | {"descent_0": arrays["descent_0"].astype(np.float32)}, fit)
    with pytest.raises(KeyError, match="best_x"):
        fit_of({name: array for name, array in arrays.items() if name != "best_x"}, fit)
    with pytest.raises(ValueError, match="another number of parameters"):
        fit_of(arrays | {"history": arrays["history"][:, :-1]}, fit)
    for name in ("best_x", "stage_x"):
        with pytest.raises(ValueError, match="another number of parameters"):
            fit_of(arrays | {name: arrays[name][:2]}, fit)
    with pytest.raises((ValueError, KeyError)):
        fit_of(arrays_of(fit), TuningFit.begin(BEGIN, problem(optimiser=NOISY)))


def planted(x, item, softness):
    """Five frames; the root of a negative number from one on, in one entry of x."""
    frame = jnp.arange(5)
    reached = jnp.where((frame >= item[1]) & (item[2] > 0), x[1] - 10, 1 + x[1] ** 2)
    return x[0] ** 2 * item[0] + jnp.sqrt(reached)


def hidden(x, item, softness):
    """A root that is not chosen: only the way back multiplies its slope, infinite, by nothing."""
    return jnp.where(jnp.arange(5) == 3, jnp.sqrt(x[0]), x[0]) + item[0] * x[1]


def test_where_a_gradient_is_not_finite_is_found():
    """The first drive, its first frame, and the parameter; nothing where all is well."""
    x = jnp.asarray([0.5, 1.0])
    items = jnp.asarray([[1.0, 3, 0], [2, 4, 0], [3, 2, 1], [1, 1, 1]])
    assert where_not_finite(planted, x, items, ZERO) == NotFinite(entry=1, item=2, frame=2)
    assert where_not_finite(planted, x, items[:2], ZERO) is None
    assert where_not_finite(planted, x + 20, items, ZERO) is None
    found = where_not_finite(planted, jnp.asarray([jnp.nan, 20.0]), items, ZERO)
    assert found == NotFinite(entry=0, item=0, frame=0)
    assert where_not_finite(hidden, x, items, ZERO) is None
    back = where_not_finite(lambda *of: hidden(*of)[:3], jnp.zeros(2), items[2:], ZERO)
    assert back == NotFinite(entry=0, item=0, frame=None)


def test_what_is_told_of_it():
    told = NotFinite(1, 2, 7).describe(["selector.floor_m", "corner_sigma_px"], 5)
    assert told == (
        "step 5: the gradient with respect to corner_sigma_px is not finite in drive 2 from frame "
        "7 on; not stepped on"
    )
    assert "drive 2; not" in NotFinite(0, 2, None).describe(["selector.floor_m"], 5)
