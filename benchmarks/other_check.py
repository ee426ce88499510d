"""How true the edges of `other_renderer` are: large sharp markers against the projected corners.

No detector is asked. Between black and white, square pixels sum up to where the edge is: the light
in a row of pixels across it is the row's length on the white side.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from other_draws import draw
from other_renderer import paper, sensor
from other_scenes import CORNERS_M, FULL_PX, SIZE_M, Scene
from other_surfaces import FAMILY, marker_paper

SIDE_PX, CROP_PX = 130.0, 320
POSES, RAYS = 8, 256


def check(mi: Any) -> None:
    """Print the RMS error of edges, row by row, and of corners where fitted edges meet."""
    edges, corners = [], []
    for k in range(POSES):
        scene = large(draw("clean", k))
        image = black_and_white(mi, scene, seed=k)
        edge_errors, corner_errors = errors_px(image, scene.project(CORNERS_M))
        edges.append(edge_errors)
        corners.append(corner_errors)
    every_edge, every_corner = np.concatenate(edges), np.array(corners)
    print(f"{POSES} markers with sides of {SIDE_PX:.0f} px, {RAYS} rays a pixel")
    print(f"edges, {len(every_edge)} rows: RMS error {np.sqrt(np.mean(every_edge**2)):.4f} px")
    print(
        f"corners: RMS error {np.sqrt(np.mean(every_corner**2)):.4f} px a coordinate, "
        f"largest {np.abs(every_corner).max():.4f} px, mean {every_corner.mean(axis=(0, 1))} px"
    )


def large(scene: Scene) -> Scene:
    """The same view from nearer, the marker in the middle of a wider crop."""
    for _ in range(20):
        scene = replace(scene, t_camera_world=scene.t_camera_world * scene.side_px() / SIDE_PX)
    at = scene.project(np.zeros((1, 3)))[0] + scene.crop_px[:2]
    left, top = np.clip(np.round(at - CROP_PX / 2), 0, np.array(FULL_PX) - CROP_PX).astype(int)
    return replace(scene, crop_px=(int(left), int(top), CROP_PX, CROP_PX))


def black_and_white(mi: Any, scene: Scene, seed: int) -> np.ndarray:
    """The marker in even light, (H, W) float: the white part of each square pixel."""
    panel = marker_paper(FAMILY, scene.truth["id"])
    side_m = SIZE_M * len(panel) / (len(panel) - 2)
    even = {"type": "directional", "direction": [0, 0, -1], "irradiance": float(np.pi)}
    world = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "panel": paper(mi, panel, side_m),
            "sun": even,
        }
    )
    camera = sensor(mi, scene, 0.0, {"type": "box"})
    return np.array(mi.render(world, sensor=camera, spp=RAYS, seed=seed))[..., 0]


def errors_px(image: np.ndarray, corners_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the four outer edges, (rows,), and of the corners where they meet, (4, 2)."""
    residuals, lines = [], []
    middle = corners_px.mean(axis=0)
    for a, b in zip(corners_px, np.roll(corners_px, -1, axis=0), strict=True):
        # Along the axis that the edge is nearer to; across it the light is summed.
        along = int(abs((b - a)[1]) > abs((b - a)[0]))
        low, high = sorted((a[along], b[along]))
        inset = 0.16 * (high - low)
        rows = np.arange(np.ceil(low + inset), np.floor(high - inset) + 1)
        slope = (b - a)[1 - along] / (b - a)[along]
        truth = a[1 - along] + slope * (rows - a[along])
        inward = np.sign((middle - (a + b) / 2)[1 - along])
        measured = [
            edge_in_row(image if along else image.T, int(row), at, inward, abs(slope))
            for row, at in zip(rows, truth, strict=True)
        ]
        residuals.append(np.array(measured) - truth)
        fit = np.polyfit(rows, measured, 1)
        normal = np.array([1, -fit[0]]) if along else np.array([-fit[0], 1])
        lines.append((normal, fit[1]))
    corners = [
        np.linalg.solve(np.stack([lines[k - 1][0], lines[k][0]]), [lines[k - 1][1], lines[k][1]])
        for k in range(4)
    ]
    return np.concatenate(residuals), np.array(corners) - corners_px


def edge_in_row(image: np.ndarray, row: int, at: float, inward: float, slope: float) -> float:
    """Where a row's pixels go from white to black, near `at`; `inward` is +1 where x leads in."""
    reach = 3 + slope
    first, last = int(np.floor(at - reach)), int(np.ceil(at + reach))
    white = float(image[row, first : last + 1].sum())
    return first - 0.5 + white if inward > 0 else last + 0.5 - white
