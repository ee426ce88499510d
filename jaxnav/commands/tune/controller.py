"""`jaxnav tune controller`: learn gains from simulated drives, new ones in every step."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.process import collect_garbage_rarely, configure_jax
from jaxnav.commands.simulate.arguments import TuneController as Arguments
from jaxnav.commands.simulate.simulate import ScenarioCar
from jaxnav.commands.tune.fit import Fitting, measure, plain_key, run_fit
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import parameters_of
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.descent import Noisy
from jaxnav.experiments.tuning.drive_loss import DriveLoss
from jaxnav.experiments.tuning.driving import ClosedLoop
from jaxnav.experiments.tuning.fit import ControllerScores, Problem
from jaxnav.experiments.tuning.objective import Batch, NotFinite
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.files import Params, load_params, output_folder
from jaxnav.pictures.tuning import controller_report
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scores import Drives
from jaxnav.sim.statistics import bootstrap_mean, wilson_interval
from jaxnav.sim.world import Spread

_CAR = (
    "controller.proportional_per_m",
    "controller.integral_per_ms",
    "controller.integral_limit_ms",
    "controller.lookahead_m",
    "controller.slows_at_rad",
)
_BASE = ("controller.speed_mps", "controller.slows_per_s")
_ON_THE_SPOT = ("controller.turns_per_s",)
# The spread between the cars; most odometers report too much where wheels slip.
_CARS = Spread(odometer_scale=(0.95, 1.2))
_SOFTNESS_M = (0.06, 0.01)  # of the switch between waypoints, at the first step and at the last
_HELD_OUT_SEED, _TEST_SEED = 10**8, 10**9


def run(args: Arguments) -> int:
    """Learn the gains, write parameters and report, and print a summary."""
    configure_jax(float64=False)
    collect_garbage_rarely()
    params = None if args.params is None else load_params(args.params)
    loop = closed_loop(args, args.scenario, params)
    tests: dict[str, ClosedLoop] = {
        name: closed_loop(args, name, params) for name in args.test_scenario
    }
    navigator = loop.rollout.navigator
    space, known = gains_of(args, navigator), parameters_of(navigator)
    before = {name: known[name] for name in space.free}
    key = plain_key("tune controller", args)
    problem, out = _problem(args, loop, space), output_folder(args.out)
    return run_fit(
        Fitting(out, key, problem, space, named=args.train),
        args.headless,
        before=before,
        test=lambda fit: _tested(args, tests, before, space.values(fit.best_x)),
        as_json=_as_json,
        draw=controller_report,
        text=_text,
    )


def closed_loop(args: Arguments, name: str, params: Params | None = None) -> ClosedLoop:
    """The closed loop of a scenario, in which every drive has a car of its own.

    Raises:
        BadInput: a file that is not valid, or a scenario in which nothing drives.
    """
    car = ScenarioCar.load(args, params)
    scenario = car.scenario(name)
    if not scenario.drives:
        raise BadInput("--scenario", f"nothing drives in {name}")
    navigator = car.navigator(scenario, make_selector(args.selector))
    noise_px = jnp.asarray(args.corner_noise_px)
    rollout = Rollout(navigator, car.vehicle, car.markers, scenario, noise_px, spread=_CARS)
    return ClosedLoop(rollout, DriveLoss(args.time, args.cross_track, args.effort, args.smoothness))


def gains_of(args: Arguments, navigator: Navigator) -> Space:
    """The space of the gains to be learned, starting at a navigator's values.

    Raises:
        BadInput: a name that its controller does not have.
    """
    known = [name for name in parameters_of(navigator) if name.startswith("controller.")]
    for name in args.train:
        if name not in known:
            expected = ", ".join(known)
            raise BadInput("--train", f"there is no {name} to learn: expected one of {expected}")
    return Space.from_navigator(
        navigator, dict.fromkeys(args.train or _by_default(navigator), True)
    )


def _by_default(navigator: Navigator) -> tuple[str, ...]:
    """The default names: all on which the drives of a vehicle depend."""
    vehicle = None if navigator.controller is None else navigator.controller.vehicle
    if not isinstance(vehicle, TwistBase):
        return _CAR
    return _BASE if vehicle.left_limit_mps > 0 else (*_BASE, *_ON_THE_SPOT)


def _problem(args: Arguments, loop: ClosedLoop, space: Space) -> Problem:
    """The loss of simulated drives: new seeds in every step, the same seeds held out."""
    begin, end = _SOFTNESS_M

    def gradients(x: Array, batch: Batch, softness: Array) -> tuple[ClosedLoop, Array, Array]:
        """The soft loop of a step, and the loss of each of its drives with its gradient."""
        soft = dataclasses.replace(loop, softness_m=softness)
        keys = _keys(args.seed + batch.items * args.seeds, args.seeds)
        return soft, *soft.value_and_grad(x, space, keys)

    def evaluate(x: Array, batch: Batch, softness: Array) -> tuple[Array, Array]:
        _, losses, slopes = gradients(x, batch, softness)
        return jnp.mean(losses), jnp.mean(slopes, axis=0)

    def explain(x: Array, batch: Batch, softness: Array) -> NotFinite | None:
        soft, _, slopes = gradients(x, batch, softness)
        broken = ~np.isfinite(np.asarray(slopes))
        if not broken.any():
            return None
        item = int(np.argmax(broken.any(axis=1)))
        key = _keys(args.seed + batch.items * args.seeds, args.seeds)[item]
        return NotFinite(int(np.argmax(broken[item])), item, soft.first_not_finite(x, space, key))

    def held_out(x: Array, stage_x: Array, stage: int) -> float:
        keys = _keys(_HELD_OUT_SEED, args.held_out_seeds)
        return float(np.mean(loop.hard_losses(x, space, keys)))

    return Problem(
        optimiser=Noisy(evaluate, args.learning_rate, args.steps),
        batch=lambda x, stage, step: Batch(step, jnp.ones(())),
        held_out=held_out,
        softness=lambda step: begin * (end / begin) ** min(1.0, step / max(1, args.steps - 1)),
        explain=explain,
        steps=args.steps,
        patience=max(10, args.steps // 3),
        same_batch=False,
    )


def _tested(
    args: Arguments,
    tests: dict[str, ClosedLoop],
    before: Mapping[str, Array],
    after: Mapping[str, Array],
) -> dict[str, tuple[ControllerScores, ControllerScores]]:
    """Test results before and after the fit, by scenario.

    Both pass their gains as arrays, so that one program drives with either.
    """
    with progress_bar(
        total=2 * args.test_seeds * len(tests), unit="drive", desc="test", disable=args.headless,
        leave=False,
    ) as bar:  # fmt: skip
        return {
            name: (
                _test(loop, args.test_seeds, before, update_after_compiling(bar)),
                _test(loop, args.test_seeds, after, bar.update),
            )
            for name, loop in tests.items()
        }


def _test(
    loop: ClosedLoop,
    count: int,
    values: Mapping[str, Array],
    progress: Callable[[int], object],
) -> ControllerScores:
    """Drive with the scenario's own car: only what the seed draws is random."""
    nominal = dataclasses.replace(loop, rollout=dataclasses.replace(loop.rollout, spread=None))
    losses, costs, trace = nominal.value(values, _keys(_TEST_SEED, count), progress)
    once = np.ones(len(losses))
    success = Drives.from_trace(trace, loop.rollout.scenario).success
    rate = float(np.mean(success))
    low, high = wilson_interval(np.array(rate), np.array(len(success)))
    own = np.asarray(trace.active)[0]
    return ControllerScores(
        loss=bootstrap_mean(losses, once),
        parts={name: float(np.mean(p)) for name, p in loop.loss.parts(costs).items()},
        time_s=bootstrap_mean(np.asarray(costs.time_s), once),
        success=(rate, float(low), float(high)),
        poses=np.asarray(trace.true_pose)[0][own],
        waypoints_m=np.asarray(loop.rollout.scenario.waypoints_m),
    )


def _keys(first: int, count: int) -> Key[Array, " S"]:
    keys: Key[Array, " S"] = jax.vmap(jax.random.key)(first + jnp.arange(count))
    return keys


def _as_json(tested: ControllerScores) -> dict[str, Any]:
    return {
        "loss": measure(tested.loss),
        "parts": tested.parts,
        "time_s": measure(tested.time_s),
        "success_rate": measure(tested.success),
    }


def _text(summary: dict[str, Any]) -> list[str]:
    lines = [f"{summary['steps']} steps: {summary['ended']}"]
    before, after = summary["parameters"]["before"], summary["parameters"]["after"]
    lines += [f"  {name}: {before[name]:.3g} -> {after[name]:.3g}" for name in before]
    lines.append("drives never seen before, before -> after:")
    for name, of in summary["test"].items():
        was, now = of["before"], of["after"]
        change = now["loss"]["value"] / was["loss"]["value"] - 1
        lines.append(
            f"  {name}: loss {was['loss']['value']:.3f} -> {now['loss']['value']:.3f} "
            f"({change:+.1%}), time {was['time_s']['value']:.2f} -> "
            f"{now['time_s']['value']:.2f} s, success {was['success_rate']['value']:.1%} -> "
            f"{now['success_rate']['value']:.1%}"
        )
    return lines
