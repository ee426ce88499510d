"""A base that turns on the spot at up to 10 rad/s, with 10 ms of exposure: is the track lost?

python benchmarks/bench_turning.py    # rewrites the last table of README-blur.md

Four fisheyes of 820 x 410 px are rendered at 30 Hz by the package's renderer, with the streaks of a
rotating rig (32 px in the middle of an image) and a rolling shutter. The base stands 1.5 m from one
marker, swings slowly for two seconds, turns ever faster for one, at full speed for two, and comes
to rest. Its odometer tells the twist with 2 % of noise in the turn.
"""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxnav
from benchmarks.bench_detection import row
from jaxnav.commands.simulate.rendered_world import SENSOR, RenderedCameras
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.core.navigator import Navigator, Output
from jaxnav.core.pose.observation import Observation
from jaxnav.detection import Tracker, make_detectors
from jaxnav.files import calib_dir, load_markers, load_rig
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene
from jaxnav.sim.sensor import Shutter

TABLE = Path(__file__).with_name("README-blur.md")
PERIOD_S, EXPOSURE_S, READOUT_S = 1 / 30, 0.01, 0.008
PLACE_M = (0.3, 0.0)
FASTEST_RADPS = 10.0
NOISE = 0.02


def rate_radps(time_s: np.ndarray) -> np.ndarray:
    """The true turn rate (N,) at times (N,)."""
    slow = 0.4 * np.sin(2 * np.pi * time_s / 2)
    ramp = FASTEST_RADPS * np.clip(time_s - 2, 0, 1)
    return np.where(time_s < 2, slow, np.where(time_s < 5, ramp, FASTEST_RADPS * (6 - time_s)))


def heading_rad(times_s: np.ndarray) -> np.ndarray:
    """The true heading (N,) at times (N,)."""
    fine = np.linspace(-1, 6, 70_001)
    turned = np.cumsum(rate_radps(np.maximum(fine, 0))) * (fine[1] - fine[0])
    return np.pi / 2 + np.interp(times_s, fine, turned - np.interp(0, fine, turned))


def poses_at(times_s: np.ndarray) -> np.ndarray:
    """T_world_vehicle (N, 7), wxyz_xyz, at times (N,)."""
    half = heading_rad(np.asarray(times_s)) / 2
    x_m, y_m = np.full_like(half, PLACE_M[0]), np.full_like(half, PLACE_M[1])
    zero = np.zeros_like(half)
    return np.column_stack([np.cos(half), zero, zero, np.sin(half), x_m, y_m, zero])


def spin(follow: bool, told: bool) -> dict[str, float]:
    """One spin: how often the marker was found while it was fast, and how far off the pose was.

    Args:
        told: whether exposure and row time are known.
    """
    rig = load_rig(calib_dir() / "qcar/rig.yaml")
    markers = load_markers(calib_dir() / "qcar/markers.yaml")
    rows = max(height for _, height in rig.image_sizes_px)
    renderer = Renderer(
        Scene.create(markers, seed=0), rig, Shutter(EXPOSURE_S, READOUT_S / rows), SENSOR
    )
    cameras = [rig.camera(c) for c in range(len(rig))]
    # What the cameras ask of their world.
    world: Any = SimpleNamespace(
        setup=SimpleNamespace(rig=rig, markers=markers), cameras=cameras, renderer=renderer
    )
    rng = np.random.default_rng(0)
    timing = (EXPOSURE_S, READOUT_S / rows) if told else (None, None)
    trackers = [Tracker(*timing) for _ in cameras] if follow else []
    eyes = RenderedCameras(world, make_detectors(markers), rng, trackers=trackers)
    navigator = Navigator(rig, markers, vehicle=TwistBase.create(1.0, 12.0, 0.15))
    step, state = jax.jit(navigator.step), navigator.init()
    believed: Output | None = None
    shown = seen = 0
    off_m, off_rad = [], []
    for stamp_s in np.arange(0, 6, PERIOD_S):
        true = np.array([*PLACE_M, heading_rad(np.array([stamp_s]))[0]])
        corners_px, visible, sigma_px = eyes.look(poses_at, float(stamp_s), believed)
        rate = float(rate_radps(np.array([stamp_s]))[0]) * (1 + NOISE * rng.standard_normal())
        observation = Observation(
            corners_px=jnp.asarray(corners_px, float),
            visible=jnp.asarray(visible),
            twist=jnp.asarray([0.0, 0, 0, 0, 0, rate]),
            dt_s=jnp.asarray(PERIOD_S if stamp_s else 0.0, float),
            corner_sigma_px=jnp.asarray(sigma_px, float),
        )
        state, believed = step(state, observation)
        assert believed is not None
        if 2.5 < stamp_s < 5.5:
            in_view = _in_view(rig, markers, true)
            shown, seen = shown + in_view, seen + (in_view and bool(np.any(visible)))
            pose = np.asarray(believed.pose)
            off_m.append(float(np.hypot(*(pose[:2] - true[:2]))))
            off_rad.append(abs(float((pose[2] - true[2] + np.pi) % (2 * np.pi) - np.pi)))
    return {
        "in view": shown,
        "found": seen,
        "m": float(np.median(off_m)),
        "most m": max(off_m),
        "deg": float(np.rad2deg(np.median(off_rad))),
        "most deg": float(np.rad2deg(max(off_rad))),
        "end m": off_m[-1],
        "exposure ms": next((1e3 * t.exposure_s for t in trackers if t.exposure_s), np.nan),
    }


def _in_view(rig: Any, markers: Any, pose: np.ndarray) -> bool:

    T_vehicle_world = T_world_vehicle_from_planar(jnp.asarray(pose)).inverse()
    return bool(jnp.any(jnp.all(rig.sees(T_vehicle_world, markers.corners_world_m), axis=-1)))


def write_table() -> None:
    """Spin with and without following, and write the table."""
    lines = [
        "<!-- rows by bench_turning.py -->",
        "",
        "A base that turns at 10 rad/s, exposed for 10 ms, `bench_turning.py` (from 5 rad/s on):",
        "",
        row(
            "", "found, of those in view", "off, median (most)", "turned, median (most)", "exposure"
        ),
        row(*["---"] * 5),
    ]
    for follow, told, name in (
        (False, False, "decode-only"),
        (True, True, "follow, timing told"),
        (True, False, "follow, timing not told"),
    ):
        got = spin(follow, told)
        lines.append(
            row(
                name,
                f"{got['found']} of {got['in view']}",
                f"{100 * got['m']:.1f} ({100 * got['most m']:.1f}) cm",
                f"{got['deg']:.2f} ({got['most deg']:.2f}) degrees",
                f"{got['exposure ms']:.1f} ms" if follow else "-",
            )
        )
        print(lines[-1], flush=True)
    text = TABLE.read_text().split("<!-- rows by bench_turning.py -->")[0].rstrip()
    TABLE.write_text(text + "\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    jaxnav.configure(float64=True)
    write_table()
