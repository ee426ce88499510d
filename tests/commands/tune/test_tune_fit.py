"""A fit in a folder: its files, its resumption, and the one-line refusals."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.commands.tune.fit import Fitting
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import with_parameters
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.descent import Noisy, Smooth
from jaxnav.experiments.tuning.fit import Problem, TuningFit, arrays_of
from jaxnav.experiments.tuning.objective import Batch, Objective, where_not_finite
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.files import load_params
from tests import worlds

NAVIGATOR = with_parameters(
    Navigator(worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar()),
    {"corner_sigma_px": jnp.asarray(2.0), "selector.floor_m": jnp.asarray(0.004)},
)
NAMES = ["corner_sigma_px", "motion.odometry_sigma", "selector.floor_m"]
SPACE = Space.from_navigator(NAVIGATOR, dict.fromkeys(NAMES, True), frozenset(NAMES[1:2]))
SIZE = SPACE.start.size
TARGETS = jnp.asarray(np.random.default_rng(0).normal(size=(3, SIZE)))
KEY = {"command": "tune filter", "seeds": 3, "train": NAMES, "params": None}


def cost(x, item, softness):
    """Four frames. What is above a covariance's diagonal costs as well: nothing is left out."""
    return jnp.ones(4) * jnp.sum(jnp.arange(1, SIZE + 1) * (x - item) ** 2)


def held_out(x, stage_x, stage) -> float:
    return float(np.sum((np.asarray(x) - np.asarray(TARGETS).mean(axis=0)) ** 2))


@jax.jit
def evaluate(x, batch, softness):
    return jax.value_and_grad(Objective(cost))(x, batch, softness)


def batch_of(x, stage, step) -> Batch:
    return Batch(TARGETS + 0.1 * np.sin(step), jnp.asarray(12.0))


def asked(cost=cost, **changes) -> Problem:
    common = {
        "optimiser": Smooth(Objective(cost)),
        "batch": lambda x, stage, step: Batch(TARGETS, jnp.asarray(12.0)),
        "held_out": held_out,
        "explain": lambda x, batch, soft: where_not_finite(cost, x, batch.items, soft),
        "steps": 12,
    }
    return Problem(**common | changes)


NOISY = {"optimiser": Noisy(evaluate, 0.3), "batch": batch_of, "same_batch": False}


def fitting(folder: Path, problem: Problem, key=KEY, cost=cost) -> Fitting:
    return Fitting(folder, key, problem, SPACE, Objective(cost).prior_sigma)


def fitted(folder: Path, problem: Problem, **how) -> TuningFit:
    return fitting(folder, problem, **how).run(headless=True)


def written(folder: Path) -> dict[str, np.ndarray]:
    return load_params(folder / "params.yaml").values


def assert_same(found: dict, expected: dict) -> None:
    assert found.keys() == expected.keys()
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


@pytest.mark.parametrize("changes", [{}, NOISY], ids=["smooth", "noisy"])
def test_the_best_is_written(tmp_path, changes, capsys):
    fit = fitted(tmp_path, asked(**changes))
    assert fit.over
    assert fit.best_loss < held_out(SPACE.start, None, 0)
    assert_same(written(tmp_path), SPACE.values(fit.best_x))
    provenance = load_params(tmp_path / "params.yaml").provenance
    assert provenance["seeds"] == 3
    losses = {"before": held_out(SPACE.start, None, 0), "after": fit.best_loss}
    assert provenance["held_out_loss"] == losses
    assert (tmp_path / "checkpoint.npz").exists()
    assert capsys.readouterr().out == ""
    with_parameters(NAVIGATOR, {name: jnp.asarray(v) for name, v in written(tmp_path).items()})


@pytest.mark.parametrize(
    ("changes", "calls"),
    [
        ({"stages": 2, "steps": 40}, 2),
        (NOISY, 2),
        pytest.param(NOISY, 1, marks=pytest.mark.long),
    ],
)
def test_an_interrupted_fit_goes_on_to_the_same_bits(tmp_path, changes, calls, capsys):
    expected = arrays_of(fitted(tmp_path, asked(**changes)))
    folder = tmp_path / "interrupted"
    folder.mkdir()
    left = iter(range(calls))

    def interrupted(*of):
        if next(left, None) is None:
            raise KeyboardInterrupt
        return held_out(*of)

    with pytest.raises(KeyboardInterrupt):
        fitted(folder, asked(**changes | {"held_out": interrupted}))
    kept = (folder / "checkpoint.npz").exists()
    assert kept == (folder / "params.yaml").exists()
    assert kept or calls == 1
    assert_same(arrays_of(fitted(folder, asked(**changes))), expected)
    assert_same(written(folder), written(tmp_path))
    said = capsys.readouterr().out
    assert said.count("\n") == said.count("going on after step") == kept
    # Once it has ended there is nothing to do.
    assert fitted(folder, asked(**changes)).step == int(expected["step"])


@pytest.mark.parametrize(
    ("key", "told"),
    [
        (KEY | {"seeds": 4}, r"whose seeds is 3 and not 4: choose another --out$"),
        (KEY | {"loss": "score"}, r"whose loss is None and not 'score'"),
        ({k: v for k, v in KEY.items() if k != "train"}, r"whose train is \['corner_.* not None"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(tmp_path, key, told):
    fitted(tmp_path, asked(steps=1))
    checkpoint = tmp_path / "checkpoint.npz"
    before = checkpoint.read_bytes()
    with pytest.raises(BadInput, match=told) as caught:
        fitted(tmp_path, asked(steps=1), key=key)
    assert str(caught.value).startswith(f"{checkpoint}: is of another run, whose ")
    assert "\n" not in str(caught.value)
    assert checkpoint.read_bytes() == before


def test_a_damaged_checkpoint_is_refused(tmp_path):
    """Cut off, overwritten, with flipped bytes anywhere: one line, or the very same fit."""
    run = fitting(tmp_path, asked(steps=3))
    expected = arrays_of(run.run(headless=True))
    checkpoint, rng = run.checkpoint, np.random.default_rng(0)
    whole = checkpoint.read_bytes()
    damaged = [b"", b"x" * 200, whole[:1], *(whole[: len(whole) * k // 8] for k in range(1, 8))]
    with (tmp_path / "one.npy").open("wb") as file:
        np.save(file, np.arange(3.0))
    damaged.append((tmp_path / "one.npy").read_bytes())
    for at in rng.integers(0, len(whole), 100):
        damaged.append(whole[:at] + bytes([whole[at] ^ rng.integers(1, 256)]) + whole[at + 1 :])
    for name, array in (("best_x", np.zeros(2)), ("step", np.array("three")), ("run", "[3, 4]")):
        arrays = dict(np.load(checkpoint, allow_pickle=False)) | {name: array}
        np.savez(tmp_path / "changed.npz", allow_pickle=False, **arrays)
        damaged.append((tmp_path / "changed.npz").read_bytes())
    fresh, refused = TuningFit.begin(SPACE.start, asked(steps=3)), 0
    for raw in damaged:
        checkpoint.write_bytes(raw)
        try:
            fit = run._kept(fresh)
        except BadInput as error:
            refused += 1
            told = str(error)
            assert told.startswith(f"{checkpoint}: is ")
            assert "damaged" in told or "of another run" in told
            assert "\n" not in told
            continue
        assert_same({name: arrays_of(fit)[name] for name in expected}, expected)
    assert refused > 60


def only(moves):
    """The cost of some entries alone."""
    counts = jnp.asarray(moves)
    return lambda x, item, softness: cost(
        jnp.where(counts, x, 0), jnp.where(counts, item, 0), softness
    )


@pytest.mark.parametrize("name", NAMES[:2])
def test_a_parameter_that_nothing_depends_on_is_refused(tmp_path, name):
    blind = only(np.array(SPACE.labels) != name)
    with pytest.raises(BadInput, match=rf"^--train: the loss does not depend on {name}$"):
        fitted(tmp_path, asked(blind), cost=blind)
    assert not (tmp_path / "params.yaml").exists()
    moves = np.ones(SIZE, bool)
    moves[1:10] = np.tri(3, dtype=bool).reshape(-1)  # above a covariance's diagonal there may be
    assert fitted(tmp_path, asked(only(moves), steps=2), cost=only(moves)).step == 2


LAST = SPACE.labels.index("selector.floor_m")


def breaking(x, item, softness):
    """From the third frame of the second drive on: a root's slope at 0, once the floor is small."""
    late = (jnp.arange(4) >= 2) & (item[0] == TARGETS[1, 0])
    small = jnp.where(late, jnp.maximum(x[LAST] - 0.2, 0), 1)
    return cost(x, item, softness) + 0 * jnp.sqrt(small)


def test_a_gradient_that_is_not_finite_is_told(tmp_path, capsys):
    """The step, the parameter, the drive and the frame; and the best so far stays."""
    assert SPACE.start[LAST] > 0.5 > 0.2 > TARGETS[:, LAST].mean()
    fit = fitted(tmp_path, asked(breaking), cost=breaking)
    assert fit.ended == "a gradient is not finite"
    assert fit.step > 1
    assert capsys.readouterr().out == (
        f"step {fit.step}: the gradient with respect to selector.floor_m is not finite in drive 1 "
        "from frame 2 on; not stepped on\n"
    )
    assert_same(written(tmp_path), SPACE.values(fit.best_x))
    assert np.all(np.isfinite(fit.best_x))
