"""`jaxnav simulate`: statistics of many closed-loop drives at corner level; and the car that drives
in scenarios, which `tune` has too."""

import itertools
import math
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from pydantic import Field

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.process import collect_garbage_rarely, configure_jax
from jaxnav.commands.reading import given_files
from jaxnav.commands.simulate.arguments import ScenarioCarFiles
from jaxnav.commands.simulate.arguments import Simulate as Arguments
from jaxnav.core.filter.choose import Selector
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.filter.selectors import SELECTORS, make_selector
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.errors import BadInput
from jaxnav.files import Params, Route, apply_params, limits, load_params, load_route, write_json
from jaxnav.files.reading import parse_json, read_text
from jaxnav.files.validation import ForeignEntry, validate
from jaxnav.files.writing import plain_data, sole_writer
from jaxnav.sim.bases import equipped
from jaxnav.sim.corners import see
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scenarios import Scenario, on_laps, on_route, scenarios
from jaxnav.sim.scores import Drives

_FILES = "rig", "markers", "vehicle", "route", "params"
# What a result of a version without these keys was made with.
_OLDER = {"params": None, "laps": 0, "base": "ackermann", "imu": "none", "route": None}


@dataclass(frozen=True)
class ScenarioCar:
    """The rig, markers, vehicle, parameters and route that all scenarios share.

    Attributes:
        route: in the map's coordinates; None where each scenario drives its own.
    """

    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle | TwistBase
    params: Params | None
    route: Route | None = None

    @staticmethod
    def load(files: ScenarioCarFiles, params: Params | None = None) -> "ScenarioCar":
        """Load a car from its files.

        Raises:
            BadInput: a file that is not valid.
        """
        content = given_files(files, ("rig", "markers", "vehicle"), or_qcars=True)
        vehicle = equipped(content.pop("vehicle"), files.base, files.imu)
        route = None
        if files.route is not None:
            route = load_route(files.route).relative_to(content["markers"].origin_m)
        return ScenarioCar(**content, vehicle=vehicle, params=params, route=route)

    def scenario(self, name: str) -> Scenario:
        """A scenario by its name, on this car's route if it has one.

        Raises:
            BadInput: no camera sees a marker of the map from its start, where nothing would come
                of it: its own route is one before the QCar's marker.
        """
        scenario = scenarios()[name]
        if self.route is not None:
            scenario = on_route(scenario, self.route.waypoints_m, self.route.start_pose)
        start = jnp.asarray(scenario.start_pose, self.rig.cameras.focal_px.dtype)
        _, visible = jax.jit(see)(self.rig, self.markers, T_world_vehicle_from_planar(start))
        if not visible.any():
            whose = "it"
            if self.route is None:
                whose = f"the QCar's route of {name}: give one before your markers"
            raise BadInput("--route", f"no marker of the map is in view from the start of {whose}")
        return scenario

    def navigator(self, scenario: Scenario, selector: Selector) -> Navigator:
        """The navigator for a scenario; parameters override what the scenario tells.

        Raises:
            BadInput: a parameter that does not fit it.
        """
        navigator = Navigator(
            rig=self.rig,
            markers=self.markers,
            vehicle=self.vehicle,
            waypoints_m=scenario.waypoints_m,
            selector=selector,
            motion=BicycleKalman(
                self.vehicle,
                tilt_sigma_rad=scenario.told_tilt_sigma_rad,
                height_sigma_m=scenario.told_height_sigma_m,
            ),
        )
        return navigator if self.params is None else apply_params(navigator, self.params)


def run(args: Arguments) -> int:
    """Drive every combination of selector and noise; print a table, and keep the numbers."""
    with nullcontext() if args.json is None else sole_writer(args.json):
        configure_jax(float64=False)
        collect_garbage_rarely()
        names = list(SELECTORS) if "all" in args.selector else list(dict.fromkeys(args.selector))
        wanted = list(itertools.product(names, args.corner_noise_px))
        done = _resumed(args)
        params = None if args.params is None else load_params(args.params)
        car = ScenarioCar.load(args, params)
        scenario = _scenario(args, car)
        if car.params is not None:
            print(car.params.describe())
        print(_header(scenario))
        for name, noise_px in wanted:
            key = _key(args, car, name, noise_px)
            matches = [one for one in done if _OLDER | one["run"] == key]
            result = matches[0] if matches else {"run": key} | _drive(args, car, scenario, key)
            if not matches:
                done.append(result)
            if args.json is not None:
                several = len(wanted) > 1 or len(done) > 1
                write_json(args.json, {"runs": done} if several else result)
            print(_row(result, scenario), flush=True)
    return 0


def _scenario(args: Arguments, car: ScenarioCar) -> Scenario:
    scenario = car.scenario(args.scenario)
    if args.laps:
        if not scenario.drives:
            raise BadInput("--laps", f"nothing drives in {args.scenario}")
        scenario = on_laps(scenario, args.laps)
    if scenario.turns_radps and not isinstance(car.vehicle, TwistBase):
        raise BadInput("--scenario", f"{args.scenario} turns on the spot: needs another --base")
    _navigator(car, scenario, "multi-hypothesis", told_noise_px=1.0)  # raises on bad input
    return scenario


def _navigator(
    car: ScenarioCar, scenario: Scenario, selector: str, told_noise_px: float
) -> Navigator:
    """The navigator, with the told corner sigma whatever its parameters say."""
    navigator = car.navigator(scenario, make_selector(selector))
    told_sigma_px = jnp.asarray(told_noise_px, navigator.corner_sigma_px.dtype)
    return eqx.tree_at(lambda n: n.corner_sigma_px, navigator, told_sigma_px)


def _drive(
    args: Arguments, car: ScenarioCar, scenario: Scenario, key: dict[str, Any]
) -> dict[str, Any]:
    """Run all drives of one row of the table, and return their summary."""
    name, noise_px = key["selector"], key["corner_noise_px"]
    navigator = _navigator(car, scenario, name, key["told_noise_px"])
    rollout = Rollout(navigator, car.vehicle, car.markers, scenario, noise_px)
    with progress_bar(
        total=args.seeds, unit="drive", desc=f"{name}, {noise_px} px", disable=args.headless,
        leave=False,
    ) as bar:  # fmt: skip
        keys = jax.vmap(jax.random.key)(args.seed + jnp.arange(args.seeds))
        trace = rollout.run(keys, update_after_compiling(bar))
    return Drives.from_trace(trace, scenario).summary()


def _key(args: Arguments, car: ScenarioCar, name: str, noise_px: float) -> dict[str, Any]:
    """The settings that identify a result."""
    told_noise_px = noise_px
    if car.params is not None and "corner_sigma_px" in car.params.values:
        told_noise_px = float(car.params.values["corner_sigma_px"])
    return {
        "scenario": args.scenario,
        "laps": args.laps,
        "base": args.base,
        "imu": args.imu,
        "selector": name,
        "corner_noise_px": noise_px,
        "told_noise_px": told_noise_px if args.told_noise_px is None else args.told_noise_px,
        "seeds": [args.seed, args.seed + args.seeds - 1],
    } | {name: plain_data(getattr(args, name)) for name in _FILES}


def _resumed(args: Arguments) -> list[dict[str, Any]]:
    if not args.resume or args.json is None or not args.json.exists():
        return []
    text = read_text(args.json, limits.JSON_BYTES)
    try:
        kept = parse_json(args.json, text)
    except BadInput as bad:
        raise BadInput(args.json, f"can't resume: {bad}") from None
    if not isinstance(kept, dict) or not kept.keys() & {"run", "runs"}:
        problem = "is not a result of jaxnav simulate, which has `run` or `runs`; can't resume"
        raise BadInput(args.json, problem)
    runs = kept.get("runs", [kept])
    if not isinstance(runs, list):
        raise BadInput(f"{args.json}: runs", "must be a list; can't resume")
    for index, one in enumerate(runs):
        validate(_Kept, one, args.json, f"runs[{index}]" if "runs" in kept else "")
    return runs


class _Measure(ForeignEntry):
    """A measured number; null where there is none."""

    value: Annotated[float, Field(strict=True)] | None


class _Quantiles(ForeignEntry):
    """Quantiles of a distribution."""

    median: _Measure
    p95: _Measure


class _Kept(ForeignEntry):
    """The part that is read of a row of an earlier result."""

    run: dict[str, Any]
    success_rate: _Measure
    wrong_branch_fraction_after_2s: _Measure
    wrong_once_decided_fraction: _Measure
    time_to_decide_s: _Quantiles
    median_position_error_m: _Measure
    anees: _Measure
    # On laps alone: of two and more the first two, of four and more the others.
    median_position_error_m_after_20s: _Measure | None = None
    anees_after_20s: _Measure | None = None
    median_position_error_m_after_60s: _Measure | None = None
    anees_after_60s: _Measure | None = None


def _header(scenario: Scenario) -> str:
    titles = (
        "| selector | noise px | success | wrong after 2 s | decided s, median / 95 % | "
        "wrong once decided | position error cm | ANEES |"
    )
    for after_s in scenario.scored_after_s:
        titles += f" cm after {after_s:g} s | ANEES after {after_s:g} s |"
    return f"{titles}\n|{'---|' * (titles.count('|') - 1)}"


def _row(result: dict[str, Any], scenario: Scenario) -> str:
    run, decide = result["run"], result["time_to_decide_s"]

    def number(measure: dict[str, Any]) -> float:
        value = measure["value"]
        return math.nan if value is None else float(value)

    def errors(suffix: str) -> str:
        position_m, anees = (
            number(result.get(f"{name}{suffix}") or {"value": None})
            for name in ("median_position_error_m", "anees")
        )
        return f"{position_m * 100:.2f} | {anees:.2f} |"

    row = (
        f"| {run['selector']} | {run['corner_noise_px']:g} | "
        f"{number(result['success_rate']):.1%} | "
        f"{number(result['wrong_branch_fraction_after_2s']):.3%} | "
        f"{number(decide['median']):.2f} / {number(decide['p95']):.2f} | "
        f"{number(result['wrong_once_decided_fraction']):.3%} | "
        f"{errors('')}"
    )
    return row + "".join(f" {errors(f'_after_{s:g}s')}" for s in scenario.scored_after_s)
