"""Study single frames: which of a marker's two poses each selector takes, and how good it is.

The corners go through the car's own code: candidates, selector, covariance. A frame is one random
draw of corner errors in one view.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, Shaped

from jaxnav.core.filter import kalman
from jaxnav.core.filter.bank import PoseBelief
from jaxnav.core.filter.choose import OrientationGiven, Ungated, judge_branch, position_error_m
from jaxnav.core.filter.selectors import SELECTORS, make_selector
from jaxnav.core.models.geometry import inverse_cayley, rotation_error_rad, safe_sqrt
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.candidates import find_candidates
from jaxnav.core.pose.observation import Snapshot
from jaxnav.core.pose.refine import Candidates
from jaxnav.experiments.studies.lanes import in_precision, run_lanes
from jaxnav.experiments.studies.parameters import (
    RANDOM,
    Parameter,
    cameras,
    positive,
    told_noise_px,
)
from jaxnav.experiments.studies.study import (
    Cell,
    Config,
    Progress,
    Rate,
    Schema,
    Study,
    Variable,
    nobody,
)
from jaxnav.sim.single_frames import (
    CornerErrors,
    MarkerView,
    marker_as_world,
    pinhole_rig,
    simulate_observation,
)

RIGHT, FLIPPED, DECLINED, OUTLIER, UNSEEN, INVALID = range(6)
OUTCOMES = ("right", "flipped", "declined", "outlier", "unseen", "invalid")
PINHOLE_FOCAL_PX = 320.0


def _error(description: str, default: float) -> Parameter:
    return Parameter(description, "px", default, low=0.0)


def _angle(description: str) -> Parameter:
    return Parameter(description, "deg", 0.0, low=-360.0, high=360.0, words=(RANDOM,))


PARAMETERS = {
    "range_m": positive("from the cameras to the marker's centre", "m", 2.0),
    "view_angle_deg": Parameter(
        "between the marker's normal and the line of sight", "deg", 30.0, low=0.0, high=89.0
    ),
    "azimuth_deg": _angle("where the normal leans to: 0 to the right, 90 up"),
    "roll_deg": _angle("of the marker about its normal"),
    "bearing_deg": _angle("of the marker, left of straight ahead"),
    "elevation_deg": Parameter("of the marker above the horizon", "deg", 0.0, low=-80.0, high=80.0),
    "marker_size_m": positive("side of the black square", "m", 0.172),
    "focal_px": positive("of every camera; by default 320, or a rig file's own", "px", None),
    "corner_noise_px": _error("standard deviation of a corner coordinate", 0.5),
    "corner_bias_px": _error(
        "of every corner, in a direction of its own, unknown to the estimator", 0.0
    ),
    "blur_px": _error("length of a streak, each corner is found anywhere in it", 0.0),
    "told_noise_px": positive("sigma the estimator is told (R); else the noise", "px", None),
    "prior_position_sigma_m": positive("of a prediction's error; by default none", "m", None),
    "prior_angle_sigma_deg": positive("of a prediction's error; by default none", "deg", None),
    "cameras": cameras("side by side, or the first ones of the rig file"),
    "baseline_m": Parameter(
        "between cameras that stand side by side", "m", 0.2, low=0.0, static=True
    ),
    "max_lm_steps": Parameter(
        "bound on the Levenberg-Marquardt steps", "", 12, low=1, high=1000, whole=True, static=True
    ),
    "selector": Parameter(
        "which pose is taken",
        "",
        "lowest-reprojection",
        # A single frame has no other sensor, and no filter to be gated.
        choices=tuple(
            name
            for name, selector in SELECTORS.items()
            if not isinstance(selector, OrientationGiven | Ungated)
        ),
        static=True,
    ),
}
_NUMBERS = tuple(name for name, parameter in PARAMETERS.items() if not parameter.static)


_SEEN = ("right", "flipped", "declined", "outlier", "invalid")
SCHEMA = Schema(
    kind="ambiguity",
    parameters=PARAMETERS,
    variables={
        "error_ratio": Variable("reprojection error (RMS) of the best pose over the second's"),
        "lm_steps": Variable("Levenberg-Marquardt steps of the slower candidate", dtype="int16"),
        "outcome": Variable(
            "what became of the choice", dtype="int8", of_selector=True, outcomes=OUTCOMES
        ),
        "position_error_m": Variable("of the pose that was taken", "m", of_selector=True),
        "rotation_error_deg": Variable("of the pose that was taken", "deg", of_selector=True),
        "nees": Variable(
            "squared error of right poses in sigmas, 6 degrees of freedom",
            of_selector=True,
            among=("right",),
        ),
        "flip_probability": Variable("as the selector states it", of_selector=True),
    },
    rates={
        "flip_rate": Rate(
            "flipped, of the poses given", "outcome", ("flipped",), ("right", "flipped")
        ),
        "success_rate": Rate("right, of the markers seen", "outcome", ("right",), _SEEN),
        "declined_rate": Rate("no answer, of the markers seen", "outcome", ("declined",), _SEEN),
        "invalid_rate": Rate("not finite", "outcome", ("invalid",), OUTCOMES),
    },
    box_trials=65_536,
    inner=("selector",),
    predicted="flip_probability",
)


class AmbiguityStudy(Study):
    """The study that `jaxnav study ambiguity` runs."""

    schema = SCHEMA

    def __init__(self, config: Config, rig: CameraRig | None = None):
        """Study a rig, or pinhole cameras side by side if there is none."""
        super().__init__(config)
        self.rig = None if rig is None else in_precision(rig, config.precision)

    def run(
        self, cells: Sequence[Cell], trials: range, progress: Progress = nobody
    ) -> dict[str, Shaped[np.ndarray, "cells ... trials"]]:
        programs: dict[tuple[Any, ...], list[int]] = {}
        for index, cell in enumerate(cells):
            key = (cell["cameras"], cell["baseline_m"], cell["max_lm_steps"])
            programs.setdefault(key, []).append(index)
        results = {
            name: np.empty((len(cells), *self._inner_shape(variable), len(trials)), variable.dtype)
            for name, variable in SCHEMA.variables.items()
        }
        for (count, baseline_m, max_steps), members in programs.items():
            rig = self._rig(count, baseline_m)
            numbers = [_numbers(cells[i], rig) for i in members]
            lanes = run_lanes(
                _program(self._selectors, max_steps),
                (rig, jax.random.key_data(jax.random.key(self.config.seed))),
                (np.repeat(numbers, len(trials), axis=0), np.tile(trials, len(members))),
                self.config.precision,
            )
            for name, values in lanes.items():
                values = values.reshape(len(members), len(trials), -1)
                results[name][members] = np.moveaxis(values, 2, 1).reshape(
                    results[name][members].shape
                )
        return results

    @property
    def _selectors(self) -> tuple[str, ...]:
        fixed = self.config.fixed.get("selector")
        return tuple(str(name) for name in self.config.axes.get("selector", [fixed]))

    def _inner_shape(self, variable: Variable) -> tuple[int, ...]:
        on_axis = variable.of_selector and "selector" in self.config.axes
        return (len(self._selectors),) if on_axis else ()

    def _rig(self, count: int | None, baseline_m: float) -> CameraRig:
        if self.rig is None:
            with jax.enable_x64(True):
                pinhole = pinhole_rig(count or 1, PINHOLE_FOCAL_PX, baseline_m)
            return in_precision(pinhole, self.config.precision)
        return self.rig.first(count or len(self.rig))


def _numbers(cell: Cell, rig: CameraRig) -> list[float]:
    """The traced values of a cell, in the order of `_NUMBERS`. NaN: random, or none."""
    filled: dict[str, Any] = dict(cell)
    filled["told_noise_px"] = told_noise_px(filled["told_noise_px"], filled["corner_noise_px"])
    if cell["focal_px"] is None:
        filled["focal_px"] = np.mean(rig.cameras.focal_px)
    return [np.nan if filled[n] in (None, RANDOM) else float(filled[n]) for n in _NUMBERS]


@functools.lru_cache(maxsize=64)
def _program(selectors: tuple[str, ...], max_steps: int) -> Callable[..., PyTree]:
    return functools.partial(_frame, selectors, max_steps)


def _frame(
    selectors: tuple[str, ...],
    max_steps: int,
    rig: CameraRig,
    key_data: Array,
    numbers: Float[Array, " P"],
    trial: Int[Array, ""],
) -> dict[str, Array]:
    """Measure one frame with every selector; variables per selector have a leading axis of them."""
    value = dict(zip(_NUMBERS, numbers, strict=True))
    key = jax.random.fold_in(jax.random.wrap_key_data(key_data), trial)
    view_key, corner_key, prior_key = jax.random.split(key, 3)
    rig = rig.with_focal_px(value["focal_px"])
    markers = marker_as_world(value["marker_size_m"])
    errors = CornerErrors(value["corner_noise_px"], value["corner_bias_px"], value["blur_px"])
    obs, T_world_vehicle = simulate_observation(
        _view(value, view_key), errors, rig, markers, corner_key
    )
    snapshot = Snapshot.create(rig, markers, obs, value["told_noise_px"])
    candidates = find_candidates(snapshot, max_steps=max_steps)

    choices = []
    for name in selectors:
        selector = make_selector(name)
        prior = _prior(T_world_vehicle, value, selector.hypotheses, prior_key)
        with_truth = eqx.tree_at(
            lambda s: s.obs.T_world_vehicle_true, snapshot, T_world_vehicle, is_leaf=_is_none
        )
        selection = selector(prior, candidates, with_truth)
        choices.append(_judged(candidates, selection.selected, T_world_vehicle, obs.visible))
        choices[-1]["flip_probability"] = selection.flip_probability
    costs = jnp.sort(jnp.where(candidates.valid, candidates.e1_px2, jnp.inf))
    pair = jnp.isfinite(costs[1]) & (costs[1] > 0)
    ratio = safe_sqrt(jnp.where(pair, costs[0] / jnp.where(pair, costs[1], 1), 0))
    steps = jnp.max(jnp.where(candidates.valid, candidates.steps, 0))
    return {
        "error_ratio": jnp.where(pair, ratio, jnp.nan),
        "lm_steps": steps.astype(jnp.int16),
        **{name: jnp.stack([choice[name] for choice in choices]) for name in choices[0]},
    }


def _view(value: Mapping[str, Array], key: Array) -> MarkerView:
    """The view of a trial, with its random angles drawn."""
    turns = jax.random.uniform(key, (3,), value["range_m"].dtype, -jnp.pi, jnp.pi)
    azimuth, roll, bearing = (
        jnp.where(jnp.isnan(value[name]), turn, jnp.deg2rad(value[name]))
        for name, turn in zip(("azimuth_deg", "roll_deg", "bearing_deg"), turns, strict=True)
    )
    return MarkerView(
        range_m=value["range_m"],
        bearing_rad=bearing,
        elevation_rad=jnp.deg2rad(value["elevation_deg"]),
        view_angle_rad=jnp.deg2rad(value["view_angle_deg"]),
        azimuth_rad=azimuth,
        roll_rad=roll,
    )


def _prior(
    T_world_vehicle: jaxlie.SE3, value: Mapping[str, Array], hypotheses: int, key: Array
) -> PoseBelief:
    """A prediction in the first slot, with errors drawn from its covariance; or no prediction."""
    sigma_m, sigma_rad = (
        value["prior_position_sigma_m"],
        jnp.deg2rad(value["prior_angle_sigma_deg"]),
    )
    known = jnp.isfinite(sigma_m) & jnp.isfinite(sigma_rad)
    sigmas = jnp.where(known, jnp.repeat(jnp.stack([sigma_m, sigma_rad]), 3), 1)
    xi = jnp.where(known, sigmas * jax.random.normal(key, (6,), sigmas.dtype), 0)
    T_prior = T_world_vehicle @ jaxlie.SE3.exp(xi)
    first = jnp.arange(hypotheses) == 0
    return PoseBelief(
        T_world_vehicle=jaxlie.SE3(jnp.tile(T_prior.wxyz_xyz, (hypotheses, 1))),
        covariance=jnp.tile(jnp.diag(sigmas**2), (hypotheses, 1, 1)),
        log_weight=jnp.where(first, 0, -jnp.inf).astype(sigmas.dtype),
        initialised=first & known,
        freedom=jnp.eye(6, dtype=sigmas.dtype),
        nuisance=jnp.zeros((6, 0), sigmas.dtype),
        gate_nis=jnp.inf,
    )


def _judged(
    candidates: Candidates, selected: Array, T_true: jaxlie.SE3, visible: Array
) -> dict[str, Array]:
    """The outcome and the errors of one choice, judged against the truth."""
    branch = judge_branch(candidates, selected, T_true)
    index = jnp.maximum(selected, 0)
    T = jaxlie.SE3(candidates.T_vehicle_world.wxyz_xyz[index]).inverse()
    xi = inverse_cayley(T.inverse() @ T_true)
    measured = {
        "position_error_m": position_error_m(T, T_true),
        "rotation_error_deg": jnp.rad2deg(rotation_error_rad(T, T_true)),
        "nees": kalman.nis(xi, candidates.covariance[index]),
    }
    finite = jnp.all(jnp.isfinite(jnp.stack(list(measured.values()))))
    outcome = jnp.where(branch.wrong, FLIPPED, RIGHT)
    outcome = jnp.where(branch.outlier, OUTLIER, outcome)
    outcome = jnp.where(finite, outcome, INVALID)
    # A marker in view without a finite candidate is a failure of the solver and not a refusal.
    no_pose = jnp.where(jnp.any(candidates.valid), DECLINED, INVALID)
    outcome = jnp.where(selected >= 0, outcome, no_pose)
    outcome = jnp.where(jnp.any(visible), outcome, UNSEEN)
    is_selected = (selected >= 0) & jnp.any(visible)
    return {"outcome": outcome.astype(jnp.int8)} | {
        name: jnp.where(is_selected, number, jnp.nan) for name, number in measured.items()
    }


def _is_none(leaf: object) -> bool:
    return leaf is None
