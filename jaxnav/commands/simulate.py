"""`jaxnav simulate`: many closed-loop drives at corner level, counted."""

import itertools
import json
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from tqdm import tqdm

from jaxnav.arguments import Simulate as Arguments
from jaxnav.bicycle import Vehicle
from jaxnav.bicycle_kalman import BicycleKalman
from jaxnav.commands.process import configure_jax
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle, write_json
from jaxnav.markers import MarkerMap
from jaxnav.navigator import Navigator
from jaxnav.rig import CameraRig
from jaxnav.selectors import SELECTORS, make_selector
from jaxnav.simulation.rollout import Rollout
from jaxnav.simulation.scenarios import scenarios
from jaxnav.simulation.scores import Drives


def run(args: Arguments) -> int:
    """Drive every combination of selector and noise; print a table, and keep the numbers."""
    configure_jax(float64=False)
    names = list(SELECTORS) if "all" in args.selector else list(dict.fromkeys(args.selector))
    wanted = list(itertools.product(names, args.corner_noise_px))
    done = _resumed(args)
    world = _World.load(args)
    print(_HEADER)
    for name, noise_px in wanted:
        key = _key(args, name, noise_px)
        found = [one for one in done if one["run"] == key]
        result = found[0] if found else {"run": key} | _drive(args, world, key)
        if not found:
            done.append(result)
        if args.json is not None:
            several = len(wanted) > 1 or len(done) > 1
            write_json(args.json, {"runs": done} if several else result)
        print(_row(result), flush=True)
    return 0


@dataclass(frozen=True)
class _World:
    """What all drives have in common."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: Vehicle

    @staticmethod
    def load(args: Arguments) -> "_World":
        qcar = calib_dir() / "qcar"
        return _World(
            rig=load_rig(args.rig or qcar / "rig.yaml"),
            markers=load_markers(args.markers or qcar / "markers.yaml"),
            vehicle=load_vehicle(args.vehicle or qcar / "vehicle.yaml"),
        )


def _drive(args: Arguments, world: _World, key: dict[str, Any]) -> dict[str, Any]:
    """All drives of one row of the table."""
    name, noise_px = key["selector"], key["corner_noise_px"]
    scenario = scenarios()[args.scenario]
    navigator = Navigator(
        rig=world.rig,
        markers=world.markers,
        vehicle=world.vehicle,
        waypoints_m=scenario.waypoints_m,
        selector=make_selector(name),
        motion=BicycleKalman(
            world.vehicle,
            tilt_sigma_rad=scenario.told_tilt_sigma_rad,
            height_sigma_m=scenario.told_height_sigma_m,
        ),
        corner_sigma_px=key["told_noise_px"],
    )
    rollout = Rollout(navigator, world.vehicle, world.markers, scenario, noise_px)
    with tqdm(
        total=args.seeds,
        unit="drive",
        desc=f"{name}, {noise_px} px",
        disable=args.headless,
        leave=False,
    ) as bar:
        keys = jax.vmap(jax.random.key)(args.seed + jnp.arange(args.seeds))
        trace = rollout.run(keys, bar.update)
    return Drives.of(trace, scenario).summary()


def _key(args: Arguments, name: str, noise_px: float) -> dict[str, Any]:
    """What a result belongs to."""
    return {
        "scenario": args.scenario,
        "selector": name,
        "corner_noise_px": noise_px,
        "told_noise_px": noise_px if args.told_noise_px is None else args.told_noise_px,
        "seeds": [args.seed, args.seed + args.seeds - 1],
        "rig": None if args.rig is None else str(args.rig),
        "markers": None if args.markers is None else str(args.markers),
        "vehicle": None if args.vehicle is None else str(args.vehicle),
    }


def _resumed(args: Arguments) -> list[dict[str, Any]]:
    if not args.resume or args.json is None or not args.json.exists():
        return []
    try:
        kept = json.loads(args.json.read_text())
        runs: list[dict[str, Any]] = kept.get("runs", [kept])
        assert all("run" in one for one in runs)
    except (OSError, ValueError, KeyError, TypeError, AssertionError, AttributeError):
        raise BadInput(args.json, "is not a result of jaxnav simulate; can't resume") from None
    return runs


_HEADER = (
    "| selector | noise px | success | wrong after 2 s | decided s, median / 95 % | "
    "wrong once decided | position error cm | ANEES |\n|---|---|---|---|---|---|---|---|"
)


def _row(result: dict[str, Any]) -> str:
    run, decide = result["run"], result["time_to_decide_s"]
    return (
        f"| {run['selector']} | {run['corner_noise_px']:g} | "
        f"{result['success_rate']['value']:.1%} | "
        f"{result['wrong_branch_fraction_after_2s']['value']:.3%} | "
        f"{decide['median']['value']:.2f} / {decide['p95']['value']:.2f} | "
        f"{result['wrong_once_decided_fraction']['value']:.3%} | "
        f"{result['median_position_error_m']['value'] * 100:.2f} | "
        f"{result['anees']['value']:.2f} |"
    )
