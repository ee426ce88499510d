"""Run a descent from beginning to end, with a state that can be saved and resumed.

    fit = Fit.begin(x, problem)
    while not fit.over:
        fit = take_step(fit, problem)      # one step; `fit` is all there is to save

Stages: after a descent has ended the problem may be posed anew (branches chosen again, by the
parameters found), until that changes nothing. The result of a fit is the x with the lowest loss on
held-out drives; the fit ends when `patience` steps have found no better one.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxnav.experiments.tuning.descent import Descent, Noisy, Smooth
from jaxnav.experiments.tuning.objective import Batch, NotFinite

_SAME = 1e-3  # a loss that differs by less is the same, of its size and of 1


@dataclass(frozen=True)
class Problem:
    """The definition of a fit: its optimiser, its data and its limits.

    Attributes:
        optimiser: makes the steps.
        batch: (x at which the stage began, stage, step in all) -> the batch of the next step.
        held_out: (x, x at which the stage began, stage) -> loss on drives that no step uses.
        softness: (step) -> softness of the discrete choices.
        explain: (x, batch, softness) -> where a gradient is not finite.
        steps, stages: the most of each.
        patience: number of steps without a better held-out loss after which the fit ends.
        same_batch: whether the batch is the same throughout a stage.
    """

    optimiser: Smooth | Noisy
    batch: Callable[[Float[Array, " n"], int, int], Batch]
    held_out: Callable[[Float[Array, " n"], Float[Array, " n"], int], float]
    explain: Callable[[Float[Array, " n"], Batch, Float[Array, ""]], NotFinite | None] = (
        lambda x, batch, softness: None
    )
    softness: Callable[[int], float] = lambda step: 0.0
    steps: int = 100
    stages: int = 1
    patience: int = 20
    same_batch: bool = True


@dataclass(frozen=True)
class TuningFit:
    """The state of a fit.

    `history` has a row for the beginning of every stage, with loss NaN, and one for every step
    taken: loss, held-out loss, and x.
    """

    descent: Descent
    stage_x: Float[Array, " n"]
    best_x: Float[Array, " n"]
    best_loss: float = np.inf
    best_of_stage: float = np.inf
    step: int = 0
    stage: int = 0
    stale: int = 0
    refused: int = 0  # steps not taken because a gradient was not finite
    over: bool = False
    ended: str = ""  # the reason
    history: tuple[Float[np.ndarray, " columns"], ...] = field(default=())

    @staticmethod
    def begin(x: Float[Array, " n"], problem: Problem) -> "TuningFit":
        """The state at x, before any evaluation."""
        batch, softness = problem.batch(x, 0, 0), jnp.asarray(problem.softness(0), x.dtype)
        loss = _known(problem.held_out(x, x, 0))
        descent = problem.optimiser.init(x, batch, softness)
        return TuningFit(descent, x, x, loss, loss, history=(_row(np.nan, loss, x),))


def take_step(fit: TuningFit, problem: Problem) -> TuningFit:
    """The fit after one more step."""
    x = fit.descent.x
    softness = jnp.asarray(problem.softness(fit.step), x.dtype)
    batch = problem.batch(fit.stage_x, fit.stage, fit.step)
    descent = problem.optimiser.step(fit.descent, batch, softness)
    step = fit.step + 1
    if not descent.finite:
        refused = fit.refused + 1
        hopeless = problem.same_batch or refused >= problem.patience
        over = hopeless or step >= problem.steps
        ended = "a gradient is not finite" if over else ""
        return dataclasses.replace(
            fit, descent=descent, step=step, refused=refused, over=over, ended=ended
        )
    moved = bool(jnp.any(descent.x != x))
    loss = float(fit.history[-1][1])
    if moved:
        loss = _known(problem.held_out(descent.x, fit.stage_x, fit.stage))
    better = loss < fit.best_loss
    row = _row(float(descent.loss), loss, descent.x)
    fit = dataclasses.replace(
        fit,
        descent=descent,
        step=step,
        best_x=descent.x if better else fit.best_x,
        best_loss=min(loss, fit.best_loss),
        stale=0 if better else fit.stale + 1,
        refused=0,
        history=(*fit.history, row),
    )
    if step >= problem.steps:
        return dataclasses.replace(fit, over=True, ended=f"{step} steps are done")
    if bool(descent.over) or fit.stale >= problem.patience:
        return _next_stage(fit, problem)
    return fit


def _next_stage(fit: TuningFit, problem: Problem) -> TuningFit:
    gained = fit.best_of_stage - fit.best_loss
    little = fit.stage > 0 and gained < _SAME * max(1.0, abs(fit.best_loss))
    if little or fit.stage + 1 >= problem.stages:
        ended = "converged" if bool(fit.descent.over) else "no better on held-out drives"
        return dataclasses.replace(fit, over=True, ended=ended)
    stage, x = fit.stage + 1, fit.best_x
    softness = jnp.asarray(problem.softness(fit.step), x.dtype)
    descent = problem.optimiser.init(x, problem.batch(x, stage, fit.step), softness)
    # Other branches make another loss: the best by the old one is not comparable.
    loss = _known(problem.held_out(x, x, stage))
    return dataclasses.replace(
        fit,
        descent=descent,
        stage=stage,
        stage_x=x,
        best_loss=loss,
        best_of_stage=loss,
        stale=0,
        history=(*fit.history, _row(np.nan, loss, x)),
    )


def _row(loss: float, held_out: float, x: Array) -> np.ndarray:
    return np.concatenate([[loss, held_out], np.asarray(x)])


def _known(loss: float) -> float:
    """The loss, with infinity for NaN, so that NaN is worse than any other."""
    return np.inf if np.isnan(loss) else float(loss)


_SCALARS: dict[str, Callable[[Any], Any]] = {
    "best_loss": float, "best_of_stage": float, "step": int, "stage": int, "stale": int,
    "refused": int, "over": bool, "ended": str,
}  # fmt: skip


def arrays_of(fit: TuningFit) -> dict[str, Shaped[np.ndarray, "..."]]:
    """A fit as named arrays, to be written to a file."""
    leaves = jax.tree.leaves(fit.descent)
    inner = {f"descent_{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    plain = {name: np.asarray(getattr(fit, name)) for name in ("stage_x", "best_x", *_SCALARS)}
    return inner | plain | {"history": np.array(fit.history)}


def fit_of(arrays: dict[str, Shaped[np.ndarray, "..."]], like: TuningFit) -> TuningFit:
    """The fit from which `arrays_of` made these arrays.

    Args:
        like: a fit of the same problem.

    Raises:
        KeyError, ValueError: arrays of something else.
    """
    leaves, form = jax.tree.flatten(like.descent)
    values = [arrays[f"descent_{i}"] for i in range(len(leaves))]
    for leaf, array in zip(leaves, values, strict=True):
        if leaf.shape != array.shape or leaf.dtype != array.dtype:
            raise ValueError(f"{leaf.shape} {leaf.dtype} became {array.shape} {array.dtype}")
    x = like.best_x
    shapes = [arrays[name].shape for name in ("stage_x", "best_x")]
    if arrays["history"].shape[1:] != like.history[0].shape or shapes != [x.shape] * 2:
        raise ValueError("another number of parameters")
    return TuningFit(
        descent=jax.tree.unflatten(form, [jnp.asarray(array) for array in values]),
        stage_x=jnp.asarray(arrays["stage_x"], x.dtype),
        best_x=jnp.asarray(arrays["best_x"], x.dtype),
        history=tuple(arrays["history"]),
        **{name: kind(arrays[name]) for name, kind in _SCALARS.items()},
    )


@dataclass(frozen=True)
class EstimatorScores:
    """The scores of an estimator on drives that had no part in the fit."""

    rmse_m: tuple[float, float, float]  # with its 95 % interval over drives
    anees: tuple[float, float, float]
    band: tuple[float, float]  # in which ANEES is consistent, 99.9 %
    error_m: Float[np.ndarray, " N"]  # of every judged frame
    indefinite: int  # judged frames whose covariance is indefinite by rounding; not in ANEES


@dataclass(frozen=True)
class ControllerScores:
    """The results of a controller in one scenario, on seeds never trained on."""

    loss: tuple[float, float, float]  # mean with its 95 % interval
    parts: dict[str, float]
    time_s: tuple[float, float, float]  # to the last waypoint
    success: tuple[float, float, float]
    poses: Float[np.ndarray, "frames 3"]  # of the first drive
    waypoints_m: Float[np.ndarray, "W 2"]
