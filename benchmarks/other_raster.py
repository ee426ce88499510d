"""The scenes of `other_scenes` drawn by MuJoCo: OpenGL's rasteriser, mip-maps and shadow maps.

Pixels, textures and the edges of shadows are other than a ray tracer's. Light from around reaches
everything, so that white paper beside a shadow may fill its pixels. Things have one colour, and
only the textures' mip-maps blur what is sharp.
"""

from typing import Any

import cv2
import numpy as np
from other_scenes import EXPOSURE_S, FOCAL_PX, FULL_PX, Scene, Thing
from scipy.spatial.transform import Rotation

FINER = 2  # pixels drawn along a side of one, each of four samples
_LEAST_SUBFRAMES, _SPACING_PX = 16, 0.35
_TEXELS = 640  # along the side of a panel
_MATT = 'specular="0" shininess="0" reflectance="0"'


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _texture(reflectance: np.ndarray, finer: int) -> bytes:
    levels = np.kron(np.clip(255 * reflectance, 0, 255), np.ones((finer, finer)))
    return bytes(cv2.imencode(".png", np.round(levels).astype(np.uint8))[1])


def _geom(thing: Thing) -> str:
    """A thing, in the mean of its colours."""
    x, y, z, w = Rotation.from_matrix(thing.R).as_quat()
    half = thing.half_m if thing.kind == "box" else thing.half_m[[0, 2]]
    grey = float(thing.reflectance.mean())
    return (
        f'<geom type="{thing.kind}" pos="{_numbers(thing.center_m)}" size="{_numbers(half)}" '
        f'quat="{w} {x} {y} {z}" material="matt" rgba="{grey} {grey} {grey} 1"/>'
    )


def _world(mujoco: Any, scene: Scene) -> tuple[Any, float]:
    """MuJoCo's model of a scene, and the light on white paper that it draws as full."""
    pictures = {"wall.png": _texture(scene.wall, 1)}
    surfaces, geoms = [("wall", 7.0, 4.0, -0.003)], [_geom(thing) for thing in scene.things]
    if scene.panel is not None:
        pictures["panel.png"] = _texture(scene.panel, max(_TEXELS // len(scene.panel), 1))
        surfaces.append(("panel", 1.0, scene.panel_m / 2, 0.0))
    materials = f'<material name="matt" {_MATT}/>'
    for name, repeat, half_m, z_m in surfaces:
        materials += (
            f'<texture name="{name}" type="2d" file="{name}.png"/>'
            f'<material name="{name}" texture="{name}" texrepeat="{repeat} {repeat}" {_MATT}/>'
        )
        geoms.append(
            f'<geom type="plane" pos="0 0 {z_m}" size="{half_m} {half_m} 1" material="{name}"/>'
        )
    toward = scene.light_m / np.linalg.norm(scene.light_m)
    lamp, around = scene.lamp_share / toward[2], 1 - scene.lamp_share
    full = max(lamp + around, 1.0)
    width, height = FINER * np.array(FULL_PX)
    fovy = 2 * np.arctan(FULL_PX[1] / 2 / FOCAL_PX)
    text = f"""<mujoco><compiler angle="radian"/><statistic extent="1" center="0 0 0"/>
        <visual><global offwidth="{width}" offheight="{height}"/>
        <quality shadowsize="4096" offsamples="4"/><map znear="0.02" zfar="20"/>
        <headlight ambient="{_numbers(np.full(3, around / full))}" diffuse="0 0 0"
            specular="0 0 0"/></visual>
        <asset>{materials}</asset><worldbody>
        <light pos="{_numbers(scene.light_m)}" dir="{_numbers(-toward)}" cutoff="50" exponent="0"
            diffuse="{_numbers(np.full(3, lamp / full))}" ambient="0 0 0" specular="0 0 0"/>
        <camera name="camera" pos="0 0 1" fovy="{np.rad2deg(fovy)}"/>
        {"".join(geoms)}</worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(text, pictures), full


def light(mujoco: Any, scene: Scene) -> np.ndarray:
    """What the sensor takes in, (H, W) float: the mean over the exposure, 1 is full scale."""
    model, full = _world(mujoco, scene)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    longest_px = float(np.linalg.norm(scene.streaks_px(), axis=1).max())
    count = max(_LEAST_SUBFRAMES, int(np.ceil(longest_px / _SPACING_PX))) if longest_px else 1
    width, height = FULL_PX
    total = np.zeros((height, width))
    with mujoco.Renderer(model, FINER * height, FINER * width) as renderer:
        for time_s in EXPOSURE_S * ((np.arange(count) + 0.5) / count - 0.5):
            R, t = scene.pose_at(float(time_s))
            # MuJoCo's camera has y up and looks along -z.
            data.cam_xpos[0], data.cam_xmat[0] = -R.T @ t, (R.T @ np.diag([1.0, -1, -1])).ravel()
            renderer.update_scene(data, "camera")
            fine = renderer.render()[..., 1].reshape(height, FINER, width, FINER)
            total += fine.mean(axis=(1, 3))
    left, top, columns, rows = scene.crop_px
    mean = total[top : top + rows, left : left + columns] / 255 / count
    return scene.signal() * full * mean
