"""The figures of a demo's drives: how far poses and corners are off, and who arrives."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.commands.simulate.arguments import Demo
from jaxnav.commands.simulate.demo_drives import LABELS, OPENCV, OURS, Drives, Record
from jaxnav.commands.simulate.rendered_world import RenderedWorld, expected_corners
from jaxnav.sim.drive import waypoints_passed
from jaxnav.sim.scores import WRONG_DEG

RATES = "how often it goes which way, over 20 seeds: docs/guide/demo.md"
LOST_M = 1.0  # farther off than this, a car is lost: the paper's waypoints are 1.03 m apart


def summary_of(args: Demo, world: RenderedWorld, drives: Drives, seed: int) -> dict[str, Any]:
    """What summary.json says of one seed."""
    return {
        "seed": seed,
        "selector": args.selector,
        "params": args.params,
        "route": args.route,
        "corner_backend": args.corner_backend,
        "exposure_ms": args.exposure_ms if args.blur else 0.0,
        "rolling_shutter": args.rolling_shutter,
        "corner_noise_px": args.corner_noise_px,
        "drives": {
            name: _outcome(world, record) | _score(world, record)
            for name, record in drives.driven.items()
        },
        "alongside": _score(world, drives.alongside),
    }


def overall(summaries: list[dict[str, Any]]) -> dict[str, Any]:
    """What summary.json says of several seeds: counts, and medians over them."""
    return {
        "runs": len(summaries),
        "methods": {
            name: _together([summary["drives"][name] for summary in summaries])
            for name in (OURS, OPENCV)
        },
        "alongside": _medians([summary["alongside"] for summary in summaries]),
        "seeds": summaries,
    }


def lines(summary: dict[str, Any]) -> list[str]:
    """One seed in words, a line for each drive and one for what listened."""
    told = []
    for name, drive in summary["drives"].items():
        verdict = "reached all waypoints" if drive["reached"] else "did NOT reach all waypoints"
        told.append(
            f"seed {summary['seed']}, {LABELS[name]}: {verdict} in {drive['duration_s']:.1f} s; "
            f"{_errors(drive)}"
        )
    listened = f"{LABELS[OPENCV]}, on the images of {LABELS[OURS]}"
    return [*told, f"seed {summary['seed']}, {listened}: {_errors(summary['alongside'])}"]


def overall_lines(overall: dict[str, Any]) -> list[str]:
    """All seeds in words, a line for each method."""
    return [
        f"{LABELS[name]}: reached all waypoints in {one['reached']} of {overall['runs']} drives; "
        f"median position RMSE {one['position_rmse_m']:.3f} m; "
        f"once more than {LOST_M:.0f} m off in {one['once_lost']}"
        for name, one in overall["methods"].items()
    ]


def _outcome(world: RenderedWorld, record: Record) -> dict[str, Any]:
    waypoints_m = np.asarray(world.setup.route_on_map.waypoints_m)
    passed = waypoints_passed(record.true_poses, waypoints_m)
    finished = bool(record.frames[-1].outputs[record.method].done)
    return {
        "reached": finished and passed == len(waypoints_m),
        "believes_done": finished,
        "waypoints_passed": passed,
        "duration_s": record.frames[-1].stamp_s,
        "steps": len(record.frames),
    }


def _score(world: RenderedWorld, record: Record) -> dict[str, float]:
    errors = record.errors[np.isfinite(record.errors[:, 0])]
    branches = [frame.branches[record.method] for frame in record.frames]
    judged = max(sum(bool(b.judged) for b in branches), 1)
    if not len(errors):
        errors = np.full((1, 3), np.nan)
    distance_m, yaw_deg = np.hypot(errors[:, 0], errors[:, 1]), np.rad2deg(errors[:, 2])
    return {
        "position_rmse_m": np.sqrt(np.mean(distance_m**2)),
        "position_median_m": np.median(distance_m),
        "position_worst_m": np.max(distance_m),
        "yaw_rmse_deg": np.sqrt(np.mean(yaw_deg**2)),
        "wrong_heading_fraction": np.mean(np.abs(yaw_deg) > WRONG_DEG),
        "wrong_branch_fraction": sum(bool(b.wrong) for b in branches) / judged,
        "outlier_fraction": sum(bool(b.outlier) for b in branches) / judged,
        "marker_seen_fraction": np.mean([np.any(f.observation.visible) for f in record.frames]),
        "corner_rms_px": _corner_rms_px(world, record),
    }


def _corner_rms_px(world: RenderedWorld, record: Record) -> float:
    """RMS of what was seen, along one axis, from where the true pose puts it at the stamp."""
    rig, markers = world.setup.rig, world.setup.markers
    squares = [np.zeros(0)]
    for frame in record.frames:
        true_px, _ = jax.device_get(expected_corners(rig, markers, jnp.asarray(frame.true_pose)))
        seen = np.asarray(frame.observation.visible)
        squares.append(((np.asarray(frame.observation.corners_px) - true_px)[seen] ** 2).ravel())
    together = np.concatenate(squares)
    return float(np.sqrt(np.mean(together))) if len(together) else np.nan


def _together(drives: list[dict[str, Any]]) -> dict[str, Any]:
    scores = [{k: v for k, v in drive.items() if isinstance(v, float)} for drive in drives]
    return {
        "reached": sum(drive["reached"] for drive in drives),
        "success_rate": np.mean([drive["reached"] for drive in drives]),
        "once_lost": sum(drive["position_worst_m"] > LOST_M for drive in drives),
        **_medians(scores),
    }


def _medians(scores: list[dict[str, float]]) -> dict[str, float]:
    return {key: float(np.median([score[key] for score in scores])) for key in scores[0]}


def _errors(score: dict[str, float]) -> str:
    return (
        f"position RMSE {score['position_rmse_m']:.3f} m, "
        f"wrong branch {score['wrong_branch_fraction']:.1%}, "
        f"heading over {WRONG_DEG:.0f} deg off in {score['wrong_heading_fraction']:.1%}"
    )
