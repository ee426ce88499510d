"""`jaxnav tune filter`: learn Q and R from recordings or simulated drives."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.process import collect_garbage_rarely, configure_jax
from jaxnav.commands.simulate.arguments import TuneFilter as Arguments
from jaxnav.commands.tune.data import TuningData, read_data
from jaxnav.commands.tune.fit import Fitting, measure, plain_key, run_fit
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import TUNABLES, parameters_of, with_parameters
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.branches import estimate_sequences
from jaxnav.experiments.tuning.descent import Smooth
from jaxnav.experiments.tuning.filter import FilterCost
from jaxnav.experiments.tuning.fit import EstimatorScores, Problem, TuningFit
from jaxnav.experiments.tuning.objective import Batch, Objective, where_not_finite
from jaxnav.experiments.tuning.recorded import FrameSequences
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.files import Params, apply_params, load_params, output_folder
from jaxnav.pictures.tuning import tuning_report
from jaxnav.sim.statistics import anees_band, bootstrap_mean

_STAGES = 4


def run(args: Arguments) -> int:
    """Learn the parameters, write them and a report, and print a summary."""
    configure_jax(float64=False)
    collect_garbage_rarely()
    params = None if args.params is None else load_params(args.params)
    data = read_data(args)
    navigator = data.navigator if params is None else apply_params(data.navigator, params)
    space = space_of(args, navigator, data.learned)
    cost = FilterCost(navigator, space, args.loss)
    objective = Objective(cost)
    out = output_folder(args.out)
    problem = _problem(args, cost, objective, data)
    key = plain_key("tune filter", args)
    return run_fit(
        Fitting(out, key, problem, space, objective.prior_sigma, named=args.train),
        args.headless,
        before=space.values(space.start),
        test=lambda fit: _tested(args, data, params, space, fit),
        as_json=_as_json,
        draw=tuning_report,
        text=_text,
    )


def space_of(args: Arguments, navigator: Navigator, learned: FrameSequences) -> Space:
    """The space of the parameters to be learned, starting at a navigator's values.

    Raises:
        BadInput: a name that the filter does not have, or can't learn.
    """
    names = args.train or _by_default(navigator, learned)
    known = [
        name
        for name in parameters_of(navigator)
        if not name.startswith("controller.") and not TUNABLES[name].guard
    ]
    for flag, given in (("--train", args.train), ("--full", args.full)):
        for name in given:
            if name not in known:
                expected = ", ".join(known)
                problem = f"there is no {name} to learn in this filter: expected one of {expected}"
                raise BadInput(flag, problem)
    try:
        return Space.from_navigator(navigator, dict.fromkeys(names, True), frozenset(args.full))
    except ValueError as error:
        raise BadInput("--full", str(error)) from None


def _by_default(navigator: Navigator, learned: FrameSequences) -> tuple[str, ...]:
    """The default names: Q and all of R that the estimator uses for a vehicle; Q alone for a free
    body, whose recordings tell by themselves how far its corners scatter."""
    names = ("motion.acceleration_density",)
    if not isinstance(navigator.motion, BicycleKalman):
        return names
    has_gyro = navigator.motion.vehicle.gyro is not None
    gyro = ("motion.vehicle.gyro.noise_density",) if has_gyro else ()
    is_bank = isinstance(navigator.selector, MultiHypothesis)
    floors = ("selector.floor_m", "selector.floor_rad") if is_bank else ("motion.vision_floor",)
    brings_sigma = learned.obs.corner_sigma_px is not None
    corners = "model_sigma_px" if brings_sigma else "corner_sigma_px"
    return (*names, "motion.odometry_sigma", *gyro, *floors, corners)


def _problem(args: Arguments, cost: FilterCost, objective: Objective, data: TuningData) -> Problem:
    made: dict[int, list[Batch]] = {}

    def of_stage(x: Array, stage: int) -> list[Batch]:
        if stage not in made:
            made.clear()
            made[stage] = cost.batches(x, data.learned, data.held_out)
        return made[stage]

    return Problem(
        optimiser=Smooth(objective),
        batch=lambda x, stage, step: of_stage(x, stage)[0],
        held_out=lambda x, stage_x, stage: float(cost.mean(x, of_stage(stage_x, stage)[1])),
        explain=lambda x, batch, soft: where_not_finite(cost, x, batch.items, soft),
        steps=args.steps,
        stages=_STAGES,
    )


def _tested(
    args: Arguments, data: TuningData, params: Params | None, space: Space, fit: TuningFit
) -> dict[str, tuple[EstimatorScores, EstimatorScores]]:
    """Results before and after the fit, by the name of the test."""
    results = {}
    for test in data.tests:
        with progress_bar(
            total=3 * test.size, unit="drive", desc="test", disable=args.headless, leave=False
        ) as bar:
            recorded = test.recorded(update_after_compiling(bar))
            before = test.navigator if params is None else apply_params(test.navigator, params)
            # As arrays, like those after the fit, so that one program estimates with both.
            before = with_parameters(before, parameters_of(before))
            after = with_parameters(before, space.values(fit.best_x))
            results[test.name] = (
                _test(before, recorded, update_after_compiling(bar)),
                _test(after, recorded, bar.update),
            )
    return results


def _test(
    navigator: Navigator, test: FrameSequences, progress: Callable[[int], object]
) -> EstimatorScores:
    estimates = estimate_sequences(navigator, test, progress)
    square_m2, nees, judged = map(np.asarray, (estimates.square_m2, estimates.nees, test.judged))
    definite = judged & ~np.isnan(nees)

    def mean(values: np.ndarray, counted: np.ndarray) -> tuple[float, float, float]:
        return bootstrap_mean(np.where(counted, values, 0).sum(axis=1), counted.sum(axis=1))

    rmse_m = tuple(float(np.sqrt(value)) for value in mean(square_m2, judged))
    freedom = 3 if isinstance(navigator.motion, BicycleKalman) else 6
    return EstimatorScores(
        rmse_m=(rmse_m[0], rmse_m[1], rmse_m[2]),
        anees=mean(nees, definite),
        band=anees_band(len(test), freedom),
        error_m=np.sqrt(square_m2[judged]),
        indefinite=int(np.sum(judged & ~definite)),
    )


def _as_json(tested: EstimatorScores) -> dict[str, Any]:
    return {
        "position_median_m": float(np.median(tested.error_m)),
        "position_rmse_m": measure(tested.rmse_m),
        "anees": measure(tested.anees),
        "anees_consistent": list(tested.band),
        "frames": {"judged": len(tested.error_m), "covariance_indefinite": tested.indefinite},
    }


def _text(summary: dict[str, Any]) -> list[str]:
    """The summary in lines: parameters, held-out loss, and the tests before and after."""
    lines = [f"{summary['steps']} steps, {summary['stages']} stages: {summary['ended']}"]
    before, after = summary["parameters"]["before"], summary["parameters"]["after"]
    for name in before:
        lines.append(f"  {name}: {_short(before[name])} -> {_short(after[name])}")
    losses = summary["held_out_loss"]
    lines.append(f"loss on what was held out: {losses['before']:.5g} -> {losses['after']:.5g}")
    for name, of in summary["test"].items():
        low, high = of["after"]["anees_consistent"]
        lines.append(f"{name}, never seen before (ANEES of {low:.2f} to {high:.2f} is honest):")
        lines += [f"  {when}: {_judgement(of[when])}" for when in ("before", "after")]
    return lines


def _judgement(of: dict[str, Any]) -> str:
    rmse, anees = of["position_rmse_m"], of["anees"]
    low, high = (100 * end for end in rmse["interval"])
    frames, without = of["frames"]["judged"], of["frames"]["covariance_indefinite"]
    less = f", without {without} of {frames} frames whose covariance is indefinite"
    return (
        f"position RMSE {100 * rmse['value']:.2f} cm ({low:.2f} to {high:.2f}), median "
        f"{100 * of['position_median_m']:.2f} cm, ANEES {anees['value']:.2f} "
        f"({anees['interval'][0]:.2f} to {anees['interval'][1]:.2f}{less if without else ''})"
    )


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_short(entry) for entry in value) + "]"
    return f"{value:.3g}"
