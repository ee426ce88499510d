"""Calibrate lenses from rendered pictures of boards: "From images" in README-intrinsics.md.

    python benchmarks/bench_lens_images.py

The lens is the QCar's (147 degrees, equidistant), in one row another of the same kind, in one a
narrow one. Beside it stands OpenCV on the same corners; for the narrow lens mrcal too, where it is
installed: it has no equidistant one.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from jaxnav.files.configuration import configure

configure(float64=True)  # before the first array, as the commands do

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from mrcal_lens import MISSING, installed, mrcal_lens  # noqa: E402
from scipy.ndimage import gaussian_filter  # noqa: E402

from jaxnav.calibrate.board.board import Board  # noqa: E402
from jaxnav.calibrate.lens.intrinsics import calibrate_images  # noqa: E402
from jaxnav.calibrate.lens.start import opencv_calibration  # noqa: E402
from jaxnav.core.models.camera import Camera  # noqa: E402
from jaxnav.files import calib_dir, load_rig  # noqa: E402
from tests.helpers.board_pictures import board_pictures  # noqa: E402

RIG = load_rig(calib_dir() / "qcar" / "rig.yaml")
SIZE_PX = RIG.image_sizes_px[0]
QCAR = RIG.camera(0)
OTHER = Camera.create((330.0, 331.0), (405.0, 207.0), "equidistant", (0.02, -0.01, 0.003, -0.0005))
NARROW = Camera.create((619.0, 620.0), (411.0, 212.0), "radtan", (-0.25, 0.08, 1e-3, -5e-4, 0.01))
CHARUCO = Board("charuco", 9, 7, 0.03, marker_m=0.022, family="4x4_50")
SPOILT = "charuco, 40, one out of focus, one twice"
ROWS = (
    (SPOILT, CHARUCO, QCAR, 40),
    ("charuco, 24", CHARUCO, QCAR, 24),
    ("charuco, 24, another camera", CHARUCO, OTHER, 24),
    ("charuco, 24, a narrow lens", CHARUCO, NARROW, 24),
    ("chessboard, 20", Board("chessboard", 9, 7, 0.03), QCAR, 20),
    ("aprilgrid, 20", Board("aprilgrid", 5, 4, 0.04, spacing=0.3, family="tag36h11"), QCAR, 20),
    ("marker, 40", Board("marker", 1, 1, 0.12, family="tag36h11", first_id=4), QCAR, 40),
)


def draw(folder: Path, board: Board, camera: Camera, count: int, spoilt: bool) -> None:
    """Pictures of the board from all sides."""
    rng = np.random.default_rng(7)
    how: dict[str, Any] = {"distances_m": (0.2, 0.45), "reach": 0.9}
    if board.kind == "marker":
        how = {"distances_m": (0.15, 0.4), "reach": 0.9, "fewest": 4}
    if camera is NARROW:
        how = {"distances_m": (0.35, 0.9), "reach": 0.9}
    for number, image in enumerate(board_pictures(board, camera, SIZE_PX, count, rng, **how)):
        if spoilt and number == 11:
            image = gaussian_filter(image, 4.0)
        cv2.imwrite(str(folder / f"{number}.png"), image)
        if spoilt and number == 20:
            cv2.imwrite(str(folder / "twice.png"), image)


def main() -> None:
    """Print a row for each board."""
    print(
        "| board | corner noise, px | focal error, px | in its sigmas | centre error, px "
        "| disagreement | left out | cv2: focal error, px | mrcal | s |"
    )
    print("|" + "---|" * 10)
    for name, board, camera, count in ROWS:
        truth = np.concatenate([camera.focal_px, camera.center_px])
        lens = "radtan" if camera is NARROW else "equidistant"
        with tempfile.TemporaryDirectory() as folder:
            draw(Path(folder), board, camera, count, name == SPOILT)
            begin = time.perf_counter()
            collected, found = calibrate_images(board, [Path(folder)], lens)
            took_s = time.perf_counter() - begin
        fit, views = found.fit, collected.views
        off = np.abs(fit.parameters[:4] - truth)
        try:
            matrix, _ = opencv_calibration(views, views.views, lens)
            opencv = f"{np.abs(np.diag(matrix)[:2] - truth[:2]).max():.3f}"
        except cv2.error:
            opencv = "throws"
        mrcal = "-"
        if installed() and camera is NARROW:
            other = mrcal_lens(views, board, float(truth[0]), np.array([[410.0, 205.0]]))
            if other is not None:
                mrcal = f"{np.abs(other.parameters[:2] - truth[:2]).max():.3f}"
        print(
            f"| {name} | {fit.sigma_px:.4f} | {off[:2].max():.3f} "
            f"| {np.max(off[:2] / fit.sigma[:2]):.1f} | {off[2:].max():.3f} | {fit.inflation:.2f} "
            f"| {', '.join(found.left_out) or '-'} | {opencv} | {mrcal} | {took_s:.0f} |",
            flush=True,
        )
    if not installed():
        print(MISSING)


if __name__ == "__main__":
    main()
