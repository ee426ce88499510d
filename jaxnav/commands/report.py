"""What a command hands over: figures and numbers in files, and lines on the terminal."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from jaxnav import __version__
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import points_in_world
from jaxnav.errors import visible
from jaxnav.files import atomic_path, write_json
from jaxnav.files.provenance import Calibrated, calibrated_now

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from matplotlib.text import Text

PNG_DPI = 110
_NORMAL_SIDES = 0.8  # length of a drawn normal, in sides of the marker


def write_report(
    folder: Path,
    summary: dict[str, Any],
    lines: Iterable[str] = (),
    name: str = "summary.json",
    **figures: "Figure",
) -> None:
    """Write the results of a command into a folder, and print what they say.

    Args:
        name: of the file of the numbers.
        figures: pictures, by their names without `.png`.
    """
    write_json(folder / name, summary)
    for picture, figure in figures.items():
        save_figure(figure, folder / f"{picture}.png")
    for line in lines:
        print(line, flush=True)


def publish(
    folder: Path,
    report: dict[str, Any],
    figure: "Figure",
    lines: Iterable[str],
    files: Iterable[str],
) -> None:
    """Write report.json and report.png of a `jaxnav calibrate` command, and print what they say.

    Args:
        files: that were written into the folder before.
    """
    where = f"{', '.join([*files, 'report.json', 'report.png'])} in {folder}"
    shown = [visible(line) for line in (*lines, where)]
    write_report(folder, report, shown, name="report.json", report=figure)


def provenance(command: str, data: Sequence[Path | np.ndarray]) -> Calibrated:
    """What the files of a `jaxnav calibrate` command state: date, tool, digest of the data."""
    return calibrated_now(f"jaxnav {__version__} calibrate {command}", data)


def save_figure(figure: "Figure", path: Path, dpi: float = PNG_DPI) -> None:
    """Write a figure, as JPEG where the file's name ends so, else as PNG; whole or not at all."""
    for text in _words(figure):
        # Names of files and markers are no formulas, and may hold any characters.
        text.set_parse_math(False)
        text.set_text("\n".join(visible(line) for line in text.get_text().split("\n")))
    with atomic_path(path) as beside, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from")  # a box stands for it
        form = "jpeg" if path.suffix.lower() in (".jpg", ".jpeg") else "png"
        figure.savefig(beside, dpi=dpi, format=form)


def _words(artist: "Artist") -> Iterator["Text"]:
    """All texts of a figure except at its ticks, which are numbers and formulas of powers."""
    from matplotlib.axis import Axis, Tick  # whoever has a figure has loaded it
    from matplotlib.text import Text

    for child in artist.get_children():
        if isinstance(child, Text):
            yield child
        elif isinstance(child, Axis):
            yield child.label
        elif not isinstance(child, Tick):
            yield from _words(child)


def corners_in_world(markers: MarkerMap) -> Float[np.ndarray, "M 4 3"]:
    """Corners (M, 4, 3) of a map in the world of its file, m, float64."""
    corners_m = jax.jit(lambda: markers.corners_world_m)()  # one program in place of dozens
    return np.asarray(points_in_world(corners_m, markers.origin_m), float)


def normals_px(
    camera: Camera, Ts_camera_marker: jaxlie.SE3, sizes_m: Float[np.ndarray | jax.Array, " #N"]
) -> Float[np.ndarray, "N 2 2"]:
    """The normals of N markers in an image, (N, 2, 2): foot and tip, x y, px."""
    length_m = _NORMAL_SIDES * jnp.asarray(sizes_m)[..., None]
    foot = Ts_camera_marker.translation()
    tip = foot + length_m * Ts_camera_marker.rotation().as_matrix()[:, :, 2]
    return np.asarray(camera.project(jnp.stack([foot, tip], axis=1)))
