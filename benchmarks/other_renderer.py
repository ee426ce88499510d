"""Pictures of markers drawn by another renderer than the package's: by Mitsuba 3, a ray tracer, or
by MuJoCo, which draws with OpenGL.

    pip install mitsuba                                           # or mujoco
    python benchmarks/other_renderer.py --out DIR --count 60      # a folder with truth.yaml a set
    python benchmarks/other_renderer.py --out DIR --by mujoco
    python benchmarks/other_renderer.py --check                   # how true Mitsuba's edges are

Each picture is the mean, in linear light, of sub-frames of a moving pinhole camera. The truth is
at the middle of the exposure. Pixels: the centre of the top-left pixel is (0, 0).
"""

import argparse
import os
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import other_raster
from other_draws import SETS, draw
from other_scenes import (
    CORNERS_M,
    EXPOSURE_S,
    FOCAL_PX,
    FULL_PX,
    SIZE_M,
    Scene,
    Thing,
)
from other_surfaces import FAMILY

# A pixel, of a picture without motion; of a moving one each sub-frame has a sixteenth. Their own
# noise is 1 to 2 grey levels, and falls with their root.
RAYS = 256
LEAST_SUBFRAMES, SPACING_PX = 24, 0.3
NOISE = 3.0  # grey levels
PIXEL_PX = 12**-0.5  # standard deviation of a square pixel


def installed(name: str) -> Any:
    """The other renderer's module."""
    try:
        return import_module(name)
    except ImportError:
        sys.exit(f"the other renderer is not installed: pip install {name}")


def renderer() -> Any:
    """Mitsuba, in its plain variant."""
    mitsuba = installed("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    import_module("drjit").set_thread_count(int(os.environ.get("OMP_NUM_THREADS", "2")))
    return mitsuba


def rigid(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The 4x4 transform, float."""
    return np.vstack([np.column_stack([R, t]), [0, 0, 0, 1.0]])


def diffuse(mi: Any, reflectance: np.ndarray, repeat: float = 1.0) -> dict:
    """A matt surface; its top row is at the largest v. Between texels nothing is smoothed."""
    texels = np.repeat(reflectance[::-1, :, None], 3, axis=2).astype(np.float32)
    return {
        "type": "diffuse",
        "reflectance": {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(texels)),
            "raw": True,
            "filter_type": "nearest",
            "to_uv": mi.ScalarTransform4f().scale(repeat),
        },
    }


def shapes_of(mi: Any, thing: Thing) -> list[dict]:
    """Mitsuba's shapes of a thing."""
    T, coat = mi.ScalarTransform4f, diffuse(mi, thing.reflectance)
    place = T(rigid(thing.R, thing.center_m))
    if thing.kind == "box":
        return [{"type": "cube", "to_world": place @ T().scale(thing.half_m.tolist()), "b": coat}]
    radius, z = float(thing.half_m[0]), float(thing.half_m[2])
    balls = [
        {"type": "sphere", "to_world": place @ T().translate([0, 0, end]) @ T().scale(radius)}
        for end in (-z, z)
    ]
    tube = {"type": "cylinder", "p0": [0, 0, -z], "p1": [0, 0, z], "radius": radius}
    return [shape | {"b": coat} for shape in (*balls, tube | {"to_world": place})]


def paper(mi: Any, panel: np.ndarray, side_m: float) -> dict:
    """A square sheet in the world's x-y plane, around its origin."""
    half = mi.ScalarTransform4f().scale([side_m / 2, side_m / 2, 1])
    return {"type": "rectangle", "to_world": half, "b": diffuse(mi, panel)}


def room(mi: Any, scene: Scene) -> Any:
    """Mitsuba's scene. Light on the marker is such that paper of reflectance 1 has radiance 1."""
    T = mi.ScalarTransform4f
    world: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 1},
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, -0.001]) @ T().scale([4, 4, 1]),
            "b": diffuse(mi, scene.wall, 7.0),
        },
    }
    if scene.panel is not None:
        world["panel"] = paper(mi, scene.panel, scene.panel_m)
    distance_m = float(np.linalg.norm(scene.light_m))
    # Seen from the marker a small disc: irradiance = radiance * area * cosine / distance^2.
    seen = np.pi * scene.light_radius_m**2 * scene.light_m[2] / distance_m**3
    world["lamp"] = {
        "type": "disk",
        "to_world": T().look_at(origin=scene.light_m.tolist(), target=[0, 0, 0], up=[0.3, 1, 0.2])
        @ T().scale(scene.light_radius_m),
        "emitter": {"type": "area", "radiance": grey(scene.lamp_share * np.pi / seen)},
    }
    world["around"] = {"type": "constant", "radiance": grey(1 - scene.lamp_share)}
    for k, thing in enumerate(scene.things):
        world |= {f"thing{k}_{i}": shape for i, shape in enumerate(shapes_of(mi, thing))}
    return mi.load_dict(world)


def grey(value: float) -> dict:
    """A colour without colour."""
    return {"type": "rgb", "value": float(value)}


def sensor(mi: Any, scene: Scene, time_s: float, rfilter: dict) -> Any:
    """The camera at a time. Mitsuba's looks along z as well, but has x to the left and y up."""
    R, t = scene.pose_at(time_s)
    to_world = rigid(R.T @ np.diag([-1.0, -1, 1]), -R.T @ t)
    film = dict(zip(("width", "height"), FULL_PX, strict=True))
    crop = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.rad2deg(2 * np.arctan(FULL_PX[0] / 2 / FOCAL_PX))),
            "near_clip": 0.001,
            "to_world": mi.ScalarTransform4f(to_world),
            "sampler": {"type": "multijitter"},
            "film": film
            | dict(zip(crop, scene.crop_px, strict=True))
            | {
                "type": "hdrfilm",
                "rfilter": rfilter,
                "sample_border": True,
                "pixel_format": "luminance",
                "component_format": "float32",
            },
        }
    )


def light(mi: Any, scene: Scene, rays: int = RAYS) -> np.ndarray:
    """What the sensor takes in, (H, W) float: the mean over the exposure, 1 is full scale."""
    # A square pixel behind a lens that draws points as Gaussians, taken together as one Gaussian.
    spread = {"type": "gaussian", "stddev": float(np.hypot(scene.lens_px, PIXEL_PX))}
    longest_px = float(np.linalg.norm(scene.streaks_px(), axis=1).max())
    moving = longest_px > 0
    count = max(LEAST_SUBFRAMES, int(np.ceil(longest_px / SPACING_PX))) if moving else 1
    times_s = EXPOSURE_S * ((np.arange(count) + 0.5) / count - 0.5)
    world = room(mi, scene)
    total = np.zeros(scene.crop_px[3:1:-1])
    for k, time_s in enumerate(times_s):
        camera = sensor(mi, scene, float(time_s), spread)
        each = max(rays // 16, 1) if moving else rays
        total += np.array(mi.render(world, sensor=camera, spp=each, seed=k))[..., 0]
    return scene.signal() * total / count


def picture(signal: np.ndarray, response: str, rng: np.random.Generator) -> np.ndarray:
    """The camera's image, (H, W) uint8, of what its sensor takes in."""
    signal = np.clip(signal, 0, 1)
    if response == "srgb":  # IEC 61966-2-1
        low = signal <= 0.0031308
        signal = np.where(
            low, 12.92 * signal, 1.055 * np.maximum(signal, 1e-9) ** (1 / 2.4) - 0.055
        )
    noisy = 255 * signal + NOISE * rng.standard_normal(signal.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def truth_of(scene: Scene) -> dict:
    """What is known of a picture, of plain lists and numbers; lengths m, angles rad, times s."""
    streaks = scene.streaks_px()
    marker = "corners_px" if scene.truth["id"] is not None else "panel_corners_px"
    return scene.truth | {
        marker: np.round(scene.project(CORNERS_M), 5).tolist(),
        "side_px": round(scene.side_px(), 3),
        "streak_px": np.round(streaks[0], 4).tolist(),
        "corner_streaks_px": np.round(streaks[1:], 4).tolist(),
        "focal_px": [FOCAL_PX, FOCAL_PX],
        "center_px": scene.center_px().tolist(),
        "T_camera_marker": np.round(rigid(*scene.pose_at(0.0)), 8).tolist(),
        "camera_angular_rad_s": np.round(scene.angular_rad_s, 6).tolist(),
        "camera_linear_m_s": np.round(scene.linear_m_s, 6).tolist(),
        "lens_px": round(scene.lens_px, 4),
        "response": scene.response,
    }


def light_by(name: str, rays: int) -> Callable[[Scene], np.ndarray]:
    """`light` of a scene by one of the renderers."""
    if name == "mujoco":
        os.environ.setdefault("MUJOCO_GL", "egl")
        return partial(other_raster.light, installed("mujoco"))
    return partial(light, renderer(), rays=rays)


def write_set(
    light_of: Callable[[Scene], np.ndarray], kind: str, arguments: argparse.Namespace
) -> None:
    """Write a set's pictures and its truth.yaml."""
    out, seed = arguments.out / kind, arguments.seed
    out.mkdir(parents=True, exist_ok=True)
    pictures = []
    for index in range(arguments.count):
        scene = draw(kind, index, seed, tuple(arguments.size))
        rng = np.random.default_rng([seed, index])
        image = picture(light_of(scene), scene.response, rng)
        cv2.imwrite(str(out / f"{index:03}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        pictures.append({"image": f"{index:03}.png"} | truth_of(scene))
        every = {"family": FAMILY, "size_m": SIZE_M, "exposure_s": EXPOSURE_S}
        text = yaml.safe_dump(
            every | {"pictures": pictures}, sort_keys=False, default_flow_style=None, width=100
        )
        (out / "truth.yaml").write_text(text)


def main() -> None:
    """Write the sets, or check the edges."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder, with one folder in it a set")
    parser.add_argument("--count", type=int, default=60, help="pictures a set")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=SETS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120), help="width, height")
    parser.add_argument("--by", choices=("mitsuba", "mujoco"), default="mitsuba")
    parser.add_argument("--rays", type=int, default=RAYS, help="Mitsuba's, a pixel")
    parser.add_argument("--check", action="store_true", help="print how true the edges are")
    arguments = parser.parse_args()
    if arguments.check:
        import_module("other_check").check(renderer())
    if arguments.out:
        light_of = light_by(arguments.by, arguments.rays)
        for kind in arguments.sets:
            write_set(light_of, kind, arguments)


if __name__ == "__main__":
    main()
