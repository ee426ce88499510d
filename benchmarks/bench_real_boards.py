"""Calibrate lenses from real pictures of boards, against OpenCV and mrcal on the same corners.

    python benchmarks/bench_real_boards.py

The sets are the folders of `JAXNAV_DATA`/boards, or of ../shared/data/boards, with a `board.yaml`
in them or in `BOARDS`. Halves: each half of the views is calibrated by itself (even and odd views,
then the first and the last), in sigmas of the difference; each lens then has to explain the views
of the other half, where only the poses are free. mrcal runs with its defaults: it leaves out
corners that fit badly, finds by how much the board is bent, and holds the coefficients down a
little. Without it (`apt install mrcal`) its tables are left out.
"""

import os
import time
from dataclasses import replace
from pathlib import Path

from jaxnav.files.configuration import configure

configure(float64=True)  # before the first array, as the commands do

import numpy as np  # noqa: E402
from mrcal_lens import MISSING, installed, mrcal_lens  # noqa: E402

from jaxnav.calibrate.board.board import Board  # noqa: E402
from jaxnav.calibrate.board.images import collect_views  # noqa: E402
from jaxnav.calibrate.board.views import BoardViews  # noqa: E402
from jaxnav.calibrate.lens import bundle as lens_bundle  # noqa: E402
from jaxnav.calibrate.lens.intrinsics import LensCalibration, calibrate_lens  # noqa: E402
from jaxnav.calibrate.lens.maps import (  # noqa: E402
    grid_px,
    projection_difference,
    projection_sigma,
)
from jaxnav.calibrate.lens.start import board_poses, opencv_calibration  # noqa: E402
from jaxnav.commands.calibrate.board import read_board  # noqa: E402
from jaxnav.core.models.camera import Camera  # noqa: E402
from jaxnav.errors import BadInput  # noqa: E402

DATA = Path(os.environ.get("JAXNAV_DATA", Path(__file__).parents[2] / "shared/data")) / "boards"
BOARDS = {
    "squares-gloworm-320": Board("chessboard", 9, 7, 0.0254),
    "squares-lifecam-480": Board("chessboard", 11, 11, 0.0254),
    "squares-picam-640": Board("chessboard", 8, 8, 0.0254),
}


def unseen_px(lens: str, parameters: np.ndarray, views: BoardViews) -> tuple[float, float]:
    """RMS distance of all corners from their predictions where only poses are free; the median."""
    seen, y = lens_bundle.padded(views, parameters, board_poses(views, lens, parameters))
    held = lens_bundle.solve(lens, y, seen, seen.present, np.zeros(lens_bundle.COUNT, bool))
    distance_px = np.linalg.norm(np.asarray(held.residual_px), axis=2)[np.asarray(seen.present)]
    return float(np.sqrt(np.mean(distance_px**2))), float(np.median(distance_px))


def opencv_parameters(views: BoardViews) -> np.ndarray:
    """(9,) of cv2.calibrateCamera on these corners."""
    matrix, coefficients = opencv_calibration(views, views.views, "radtan")
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients])


def halves(views: BoardViews) -> list[tuple[BoardViews, BoardViews]]:
    """Even and odd views, then the first and the last."""
    shown, middle = views.views, len(views.views) // 2
    pairs = ((shown[::2], shown[1::2]), (shown[:middle], shown[middle:]))
    return [(replace(views, views=one), replace(views, views=other)) for one, other in pairs]


def compared(views: BoardViews) -> tuple[float, list[str]]:
    """The largest difference of two halves in its sigmas, and the errors of unseen views."""
    worst, errors = 0.0, []
    for pair in halves(views):
        fits = [_half(half) for half in pair]
        if fits[0] is not None and fits[1] is not None and fits[0].fit.lens == fits[1].fit.lens:
            sigma = np.hypot(fits[0].fit.sigma, fits[1].fit.sigma)
            apart = np.abs(fits[0].fit.parameters - fits[1].fit.parameters)
            worst = max(worst, float(np.max(apart[sigma > 0] / sigma[sigma > 0])))
        for trained, fit, other in zip(pair, fits, pair[::-1], strict=True):
            theirs = unseen_px("radtan", opencv_parameters(trained), other)
            ours = (np.nan, np.nan)
            if fit is not None:
                ours = unseen_px(fit.fit.lens, fit.fit.parameters, other)
            errors.append(f"{ours[0]:.3f} {ours[1]:.3f} / {theirs[0]:.3f} {theirs[1]:.3f}")
    return worst, errors


def _half(views: BoardViews) -> LensCalibration | None:
    try:
        return calibrate_lens(views)
    except BadInput as error:
        print(f"    half refused: {error}")
        return None


def beside_mrcal(
    found: LensCalibration, of_opencv: np.ndarray, views: BoardViews, board: Board
) -> tuple[str, str, str]:
    """Rows of three tables: the focal length, its errors of unseen views, and two maps."""
    fit, pixels = found.fit, grid_px(views.image_size_px).reshape(-1, 2)
    # jaxnav leaves views out: the others get the same ones as well.
    kept = tuple(v for v in views.views if v.name not in found.left_out)
    lenses = {
        model: mrcal_lens(views, board, of_opencv[0], pixels, model)
        for model in ("OPENCV4", "OPENCV5", "OPENCV8")
    }
    theirs, few = lenses["OPENCV5"], replace(views, views=kept)
    alike = mrcal_lens(few, board, of_opencv[0], pixels)
    focal = [f"{fit.parameters[0]:.1f} +- {fit.sigma[0]:.1f}", f"{of_opencv[0]:.1f}"]
    focal += [
        "-" if lens is None else f"{lens.parameters[0]:.1f} +- {lens.focal_sigma_px[0]:.1f}"
        for lens in lenses.values()
    ]
    if theirs is None or alike is None:
        return (" | ".join(focal), "", "")
    for pair in ((of_opencv, theirs), (opencv_parameters(few), alike)):
        mean = (pair[0][0] + pair[1].parameters[0]) / 2
        off = fit.parameters[0] - mean
        focal.append(f"{mean:.1f}: {100 * off / mean:+.2f} %, {off / fit.sigma[0]:+.1f}")
    unseen = []
    for trained, other in [each for pair in halves(views) for each in (pair, pair[::-1])]:
        half = mrcal_lens(trained, board, of_opencv[0], pixels)
        errors = (np.nan, np.nan)
        if half is not None:
            errors = unseen_px("radtan", half.parameters, other)
        unseen.append(f"{errors[0]:.3f} {errors[1]:.3f}")
    ours_px = np.sqrt(np.mean(projection_sigma(fit).shift_px.reshape(-1, 2) ** 2, axis=1))
    middle, rim = _middle(pixels, views.image_size_px)
    maps = [
        f"{np.median(sigma[part]):.2f}"
        for sigma in (ours_px, theirs.sigma_px)
        for part in (middle, rim)
    ]
    ours = fit.camera
    for parameters in (of_opencv, theirs.parameters, alike.parameters):
        camera = Camera.create(parameters[:2], parameters[2:4], "radtan", parameters[4:])
        length_px = projection_difference(ours, camera, views.image_size_px).length_px.reshape(-1)
        maps.append(f"{np.nanmedian(length_px[middle]):.2f} {np.nanmedian(length_px[rim]):.2f}")
    return " | ".join(focal), " | ".join(unseen), " | ".join(maps)


def _middle(pixels: np.ndarray, image_size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the pixels in the middle half of the image, both ways, and of the others."""
    from_middle = np.abs(pixels / (np.array(image_size_px) - 1) - 0.5)
    inside = np.all(from_middle < 0.25, axis=1)
    return inside, ~inside


def main() -> None:
    """Print a row for each set, then the tables with mrcal."""
    rows: dict[str, tuple[str, str, str]] = {}
    print(
        "| set | views | lens | fx, fy | sigma % | centre | RMS | cv2: fx, fy | RMS "
        "| halves, sigmas | unseen px, RMS median: jaxnav / cv2 | s |"
    )
    print("|" + "---|" * 12)
    for folder in sorted(path for path in DATA.iterdir() if path.is_dir()):
        own = folder / "board.yaml"
        board = read_board(own) if own.exists() else BOARDS.get(folder.name)
        if board is None:
            continue
        begin = time.perf_counter()
        collected = collect_views(board, [folder])
        try:
            found = calibrate_lens(collected.views)
        except BadInput as error:
            print(f"| {folder.name} | {error} |")
            continue
        took_s, fit = time.perf_counter() - begin, found.fit
        theirs = opencv_parameters(collected.views)
        their_rms_px, _ = unseen_px("radtan", theirs, collected.views)
        worst, errors = compared(collected.views)
        f, c = fit.parameters[:2], fit.parameters[2:4]
        print(
            f"| {folder.name} | {int(np.sum(fit.view_weights > 0))} of {len(collected.files)} "
            f"| {fit.lens} | {f[0]:.1f}, {f[1]:.1f} | {100 * np.max(fit.sigma[:2] / f):.2f} "
            f"| {c[0]:.1f}, {c[1]:.1f} | {fit.rms_px:.3f} "
            f"| {theirs[0]:.1f}, {theirs[1]:.1f} | {their_rms_px:.3f} | {worst:.1f} "
            f"| {'; '.join(errors)} | {took_s:.0f} |",
            flush=True,
        )
        if installed():
            rows[folder.name] = beside_mrcal(found, theirs, collected.views, board)
    if not installed():
        print(MISSING)
        return
    titles = (
        "fx +- sigma: jaxnav | cv2 | mrcal OPENCV4 | OPENCV5 | OPENCV8 "
        "| jaxnav from the mean of cv2 and OPENCV5, in sigmas | the same on the views jaxnav kept",
        "unseen px, RMS median, of mrcal OPENCV5: even | odd | first | last",
        "sigma, px: jaxnav, middle | border | mrcal, middle | border "
        "| apart, px, middle border: jaxnav and cv2 | and mrcal | and mrcal on the views kept",
    )
    for number, title in enumerate(titles):
        print(f"\n| set | {title} |\n|" + "---|" * (title.count("|") + 2))
        for name, cells in rows.items():
            print(f"| {name} | {cells[number]} |")


if __name__ == "__main__":
    main()
