"""Calibrate a lens by mrcal from the corners that jaxnav found, for the benchmarks beside it.

mrcal is a package of Debian and Ubuntu (`apt install mrcal`), not of Python's index: its commands
and its own Python are called, with their defaults.
"""

import json
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.views import BoardViews

MISSING = "mrcal is not installed, its columns are left out: apt install mrcal"
_COMMAND = "mrcal-calibrate-cameras"


@dataclass(frozen=True)
class MrcalLens:
    """What mrcal found.

    Attributes:
        parameters: fx fy cx cy and the coefficients in OpenCV's order.
        focal_sigma_px: (2,) standard deviations of fx and fy.
        sigma_px: (N,) how unsure it is of the projection at the pixels asked for.
    """

    parameters: np.ndarray
    focal_sigma_px: np.ndarray
    sigma_px: np.ndarray


def installed() -> bool:
    """True if mrcal's commands are here."""
    return shutil.which(_COMMAND) is not None


def mrcal_lens(
    views: BoardViews,
    board: Board,
    focal_px: float,
    pixels: np.ndarray,
    model: str = "OPENCV5",
) -> MrcalLens | None:
    """Calibrate by `mrcal-calibrate-cameras`; None where it finds nothing.

    Args:
        board: one whose points are a grid: a chessboard or a charuco board.
        focal_px: mrcal asks for a first guess.
        pixels: (N, 2), where its uncertainty is asked for.
        model: OPENCV4 (k1 k2 p1 p2), OPENCV5 (and k3: jaxnav's radtan), OPENCV8 (and k4 k5 k6).
    """
    command = shutil.which(_COMMAND)
    assert command is not None, MISSING
    columns, rows = board.columns - 1, board.rows - 1
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "corners.vnl").write_text(_corners(views, columns * rows))
        np.save(folder / "pixels.npy", pixels)
        size = [str(side) for side in views.image_size_px]
        calibrate = [
            command,
            *("--lensmodel", f"LENSMODEL_{model}", "--focal", f"{focal_px:.1f}"),
            *("--imagersize", *size, "--outdir", name, "--corners-cache", "corners.vnl"),
            *("--object-spacing", f"{board.size_m}"),
            *("--object-width-n", f"{columns}", "--object-height-n", f"{rows}"),
            "view*.png",
        ]
        done = subprocess.run(calibrate, cwd=folder, capture_output=True, text=True)
        found = sorted(folder.glob("*.cameramodel"))
        if done.returncode or not found:
            print(f"    mrcal: {(done.stderr.strip() or done.stdout.strip()).splitlines()[-1]}")
            return None
        python = Path(command).read_text().splitlines()[0].removeprefix("#!").strip()
        figures = Path(__file__).with_name("mrcal_figures.py")
        said = subprocess.run(
            [*python.split(), str(figures), str(found[0]), str(folder / "pixels.npy")],
            env={"PATH": "/usr/bin:/bin"},  # nothing of this environment's Python
            capture_output=True,
            text=True,
            check=True,
        )
    values = json.loads(said.stdout)
    return MrcalLens(
        np.array(values["parameters"]),
        np.array(values["focal_sigma_px"]),
        np.array(values["sigma_px"]),
    )


def _corners(views: BoardViews, points: int) -> str:
    """The corners as mrcal's vnlog: all points of every view in order, '-' for those not seen."""
    lines = ["# filename x y level"]
    for number, view in enumerate(views.views):
        seen = dict(zip(view.ids.tolist(), view.corners_px, strict=True))
        for point in range(points):
            x, y = seen.get(point, (0.0, 0.0))
            level = "0" if point in seen else "-"
            lines.append(f"view{number:03d}.png {x:.6f} {y:.6f} {level}")
    return "\n".join(lines) + "\n"
