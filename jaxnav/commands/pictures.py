"""Drawing for the commands: candidate poses in camera frames, and figures into files."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axis import Axis, Tick
from matplotlib.figure import Figure
from matplotlib.text import Text

from jaxnav.errors import visible
from jaxnav.files import atomic_path
from jaxnav.models.camera import Camera
from jaxnav.models.markers import MarkerMap
from jaxnav.models.origin import points_in_world
from jaxnav.models.rig import CameraRig
from jaxnav.navigator import Output
from jaxnav.plots.localisation import AnnotatedFrame

PNG_DPI = 110
_NORMAL_SIDES = 0.8  # length of a drawn normal, in sides of the marker


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    for text in _words(figure):
        # Names of files and markers are no formulas, and may hold any characters.
        text.set_parse_math(False)
        text.set_text("\n".join(visible(line) for line in text.get_text().split("\n")))
    with atomic_path(path) as beside, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from")  # a box stands for it
        figure.savefig(beside, dpi=PNG_DPI, format="png")


def _words(artist: Artist) -> Iterator[Text]:
    """All texts of a figure except at its ticks, which are numbers and formulas of powers."""
    for child in artist.get_children():
        if isinstance(child, Text):
            yield child
        elif isinstance(child, Axis):
            yield child.label
        elif not isinstance(child, Tick):
            yield from _words(child)


def corners_in_world(markers: MarkerMap) -> np.ndarray:
    """Corners (M, 4, 3) of a map in the world of its file, m, float64."""
    return np.asarray(points_in_world(markers.corners_world_m, markers.origin_m), float)


def normals_px(
    camera: Camera, Ts_camera_marker: jaxlie.SE3, sizes_m: np.ndarray | jax.Array
) -> np.ndarray:
    """The normals of N markers in an image, (N, 2, 2): foot and tip, x y, px."""
    length_m = _NORMAL_SIDES * jnp.asarray(sizes_m)
    foot = Ts_camera_marker.translation()
    tip = foot + length_m[:, None] * Ts_camera_marker.rotation().as_matrix()[:, :, 2]
    return np.asarray(camera.project(jnp.stack([foot, tip], axis=1)))


def views_of(
    rig: CameraRig,
    T_world_marker: jaxlie.SE3,
    sizes_m: jax.Array,
    images: list[np.ndarray],
    corners_px: np.ndarray,
    visible: np.ndarray,
    output: Output,
    stamp_s: float,
) -> list[AnnotatedFrame]:
    """Views of every camera's frame, with the markers seen and the poses the navigator weighed.

    Args:
        T_world_marker: poses of the map, batch axis (M,).
        sizes_m: (M,).
        images: (H, W) of each camera.
        corners_px: (C, M, 4, 2).
        visible: (C, M).
        output: the navigator's, on the host.
        stamp_s: shown in the titles.
    """
    views = []
    valid = np.flatnonzero(output.candidates.valid)
    for c, image in enumerate(images):
        T_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[c])
        sticks: dict[bool, list[np.ndarray]] = {True: [], False: []}
        for m in np.flatnonzero(visible[c]):
            for n in valid:
                T_vehicle_world = jaxlie.SE3(
                    jnp.asarray(output.candidates.T_vehicle_world.wxyz_xyz[n])
                )
                T_world_marker_m = jaxlie.SE3(T_world_marker.wxyz_xyz[m])
                T_camera_marker = T_camera_vehicle @ T_vehicle_world @ T_world_marker_m
                stick = normals_px(
                    rig.camera(c), jaxlie.SE3(T_camera_marker.wxyz_xyz[None]), sizes_m[m][None]
                )
                sticks[n == output.selected].append(stick[0])
        views.append(
            AnnotatedFrame(
                title=f"{rig.names[c]}, t = {stamp_s:.2f} s",
                image=image,
                detected_px=corners_px[c][visible[c]],
                selected_px=np.asarray(sticks[True]).reshape(-1, 2, 2),
                other_px=np.asarray(sticks[False]).reshape(-1, 2, 2),
            )
        )
    return views
