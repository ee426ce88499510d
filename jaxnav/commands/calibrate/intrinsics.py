"""`jaxnav calibrate intrinsics`: calibrate the lens of a camera, or of several."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.calibrate.board.images import CollectedViews
from jaxnav.calibrate.lens.checks import cells, reach, rim_sigma_px, tilts_deg
from jaxnav.calibrate.lens.intrinsics import LensCalibration, calibrate_images
from jaxnav.commands.bars import progress_bar
from jaxnav.commands.calibrate.arguments import CalibrateIntrinsics
from jaxnav.commands.calibrate.board import read_board
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import provenance, publish
from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.errors import BadInput
from jaxnav.files import load_rig, output_folder
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, CameraSigma, RigFile, rig_data, save_rig
from jaxnav.files.validation import validate
from jaxnav.pictures.lens import lens_report

# The yaw of a camera with such a name, until its place is measured.
_YAWS_DEG = {"front": 0.0, "left": 90.0, "rear": 180.0, "back": 180.0, "right": -90.0}

_NAMED = 5  # views without the board that are named one by one
_OTHER_PATTERN = (
    "the board is printed in the pattern that its file does not say, `legacy: true` or `legacy: "
    "false`: its points are the same"
)


def run(args: CalibrateIntrinsics) -> int:
    """Find the board in the images, fit the lenses, write camera.yaml and a report."""
    configure_jax(float64=True)
    board = read_board(args.board)
    placed = _placed(args.rig)
    unknown = [name for name in args.by_camera if placed and name not in placed]
    if unknown:
        raise BadInput(
            args.rig, f"has no camera {unknown[0]!r}: expected one of {', '.join(placed)}"
        )
    folder = output_folder(args.out)
    collected: dict[str, CollectedViews] = {}
    calibrations: dict[str, LensCalibration] = {}
    bars = partial(progress_bar, disable=args.headless)
    for name, sources in args.by_camera.items():
        with bars(unit=" step", desc=name) as bar:

            def tell(stage: str, bar: Any = bar) -> None:
                bar.set_postfix_str(stage, refresh=False)
                bar.update()

            collected[name], calibrations[name] = calibrate_images(
                board, sources, args.lens, args.max_views, tell, bars
            )

    files = [args.board, *(file for one in collected.values() for file in one.files)]
    calibrated = provenance("intrinsics", files)
    entries, cameras, advice, lines = {}, {}, list[str](), list[str]()
    for name, one in calibrations.items():
        entries[name] = _entry(name, one, placed.get(name))
        cameras[name] = _report(one, collected[name])
        advice += [f"{name}: {tip}" if len(calibrations) > 1 else tip for tip in one.advice]
        lines += _lines(name, one, collected[name])
    rig = RigFile(cameras=list((placed | entries).values()))
    file = folder / "camera.yaml"
    save_rig(file, rig.rig(), calibrated, [entry.sigma or CameraSigma() for entry in rig.cameras])
    report = {"board": str(board), "cameras": cameras, "advice": advice}
    if not placed:
        lines.append(f"for a photo: jaxnav locate PHOTO --camera {file} --marker-size-m S")
        lines.append(f"for a car: write where its cameras are into {file}, or give --rig")
    figure = lens_report(calibrations)
    publish(folder, calibrated.model_dump() | report, figure, lines, ["camera.yaml"])
    return 0


def _placed(path: Path | None) -> dict[str, CameraEntry]:
    """The cameras of a rig file, by name."""
    if path is None:
        return {}
    data = read_mapping(path)
    # A camchain has no sigmas to keep.
    if "cameras" not in data:
        data = rig_data(load_rig(path))
    return {entry.name: entry for entry in validate(RigFile, data, path).cameras}


def _entry(name: str, calibration: LensCalibration, placed: CameraEntry | None) -> CameraEntry:
    """The rig file's entry of a calibrated camera, at its place where that is known."""
    fit = calibration.fit
    coefficients = slice(4, 4 + LENS_COEFFICIENTS[fit.lens])
    before = placed.sigma if placed and placed.sigma else CameraSigma()
    update: dict[str, Any] = {
        "lens": fit.lens,
        "focal_px": fit.parameters[:2].tolist(),
        "center_px": fit.parameters[2:4].tolist(),
        "distortion": fit.parameters[coefficients].tolist(),
        "image_size_px": list(fit.views.image_size_px),
        "sigma": CameraSigma(
            # Of the focal length on the axis: what xi makes up for does not move an image.
            focal_px=(fit.parameters[:2] * fit.focal_sigma).tolist(),
            center_px=fit.sigma[2:4].tolist(),
            distortion=fit.sigma[coefficients].tolist() or None,
            position_m=before.position_m,
            rotation_deg=before.rotation_deg,
        ),
    }
    if placed is not None:
        return placed.model_copy(update=update)
    yaw_deg = _YAWS_DEG.get(name, 0.0)
    return CameraEntry(name=name, position_m=[0.0, 0.0, 0.0], yaw_deg=yaw_deg, **update)


def _report(calibration: LensCalibration, collected: CollectedViews) -> dict[str, Any]:
    fit, seen = calibration.fit, cells(calibration.fit)
    median_deg, spread_deg = tilts_deg(fit)
    return {
        "lens": fit.lens,
        "image_size_px": fit.views.image_size_px,
        "reprojection_rms_px": fit.rms_px,
        "corner_sigma_px": fit.sigma_px,
        "corners": int(fit.used.sum()),
        "parameters": {
            name: {"value": float(value), "sigma": float(sigma), "held_at_zero": name in fit.fixed}
            for name, value, sigma in zip(fit.names, fit.parameters, fit.sigma, strict=False)
        },
        "border_sigma_px": rim_sigma_px(fit),
        "held_out_sigma_px": calibration.held_out_px,
        "views": {
            "given": calibration.given,
            "in_the_fit": int(np.sum(fit.view_weights > 0)),
            "sigma_px": {
                view.name: float(sigma_px)
                for view, sigma_px in zip(fit.views.views, fit.view_sigma_px, strict=True)
            },
            "left_out": calibration.left_out,
            "downweighted": calibration.downweighted,
            "duplicates": dict(collected.duplicates),
            "unreadable": dict(collected.unreadable),
            "without_board": collected.without_board,
        },
        "coverage": {
            "corners_in_cells": seen.corners,
            "reach": reach(fit),
            "median_tilt_deg": median_deg,
            "largest_angle_between_views_deg": spread_deg,
        },
        "systematic_residual_px": seen.systematic_px,
        "findings": _notes(calibration, collected),
        "advice": calibration.advice,
    }


def _notes(calibration: LensCalibration, collected: CollectedViews) -> tuple[str, ...]:
    other = (_OTHER_PATTERN,) if collected.other_pattern else ()
    return (*other, *calibration.findings)


def _lines(name: str, calibration: LensCalibration, collected: CollectedViews) -> Iterator[str]:
    fit, unseen = calibration.fit, collected.without_board
    used = int(np.sum(fit.view_weights > 0))
    given = calibration.given + len(unseen) + len(collected.unreadable)
    yield (
        f"{name}: {fit.lens}, {used} of {given} views, {int(fit.used.sum())} corners, "
        f"RMS {fit.rms_px:.3f} px, corner noise {fit.sigma_px:.3f} px"
    )
    for parameter, value, sigma in zip(fit.names, fit.parameters, fit.sigma, strict=False):
        sure = "held at zero" if parameter in fit.fixed else f"+- {sigma:.2g}"
        yield f"  {parameter:>5} {value:12.6g} {sure}"
    left_out = [*calibration.left_out.items(), *collected.unreadable]
    if len(unseen) > _NAMED:  # as of a video
        left_out.append((f"{len(unseen)} views, {unseen[0]} first", "the board is not seen"))
    else:
        left_out += [(view, "the board is not seen: is it blurred?") for view in unseen]
    left_out += [(view, f"repeats {twin}") for view, twin in collected.duplicates]
    yield from (f"  left out: {view}: {why}" for view, why in left_out)
    for view, weight in calibration.downweighted.items():
        yield f"  counts {weight:.2g}: {view}"
    yield from (f"  note: {sentence}" for sentence in _notes(calibration, collected))
    yield from (f"  next: {sentence}" for sentence in calibration.advice)
