"""`jaxnav calibrate compare`: where two calibrations of a camera differ."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.calibrate.lens.maps import ImageMap, projection_difference
from jaxnav.commands.calibrate.arguments import CalibrateCompare
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import publish
from jaxnav.errors import BadInput
from jaxnav.files import output_folder
from jaxnav.files.cameras import camera_file
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry
from jaxnav.pictures.lens import comparison


def run(args: CalibrateCompare) -> int:
    """Compare the cameras of two files, draw a map of each, print how far they are apart."""
    configure_jax(float64=True)
    pairs = _pairs(args)
    folder = output_folder(args.out)
    maps = {
        name: projection_difference(one.camera(), other.camera(), one.size_px)
        for name, (one, other) in pairs.items()
    }
    cameras = {name: _report(*pairs[name], maps[name]) for name in pairs}
    figure = comparison(maps, f"where {args.other} draws the rays of\n{args.one}")
    lines = [
        f"{name}: {one['rms_px']:.3g} px RMS apart, {one['largest_px']:.3g} px at most at "
        f"({one['largest_at_px'][0]:.0f}, {one['largest_at_px'][1]:.0f}); focal length "
        f"{one['focal_px'][0][0]:.6g} and {one['focal_px'][1][0]:.6g} px, "
        f"{one['undrawn_percent']:.0f} % of the image not drawn by both"
        for name, one in cameras.items()
    ]
    report = {"one": str(args.one), "other": str(args.other), "cameras": cameras}
    publish(folder, report, figure, lines, ())
    return 0


def _pairs(args: CalibrateCompare) -> dict[str, tuple[CameraEntry, CameraEntry]]:
    one, other = (_cameras(path) for path in (args.one, args.other))
    if len(one) == len(other) == 1:
        other = {next(iter(one)): next(iter(other.values()))}
    both = [name for name in one if name in other]
    if not both:
        raise BadInput(
            args.other,
            f"has none of the cameras of {args.one}: {', '.join(one)} there, "
            f"{', '.join(other)} here",
        )
    for name in both:
        if one[name].image_size_px != other[name].image_size_px:
            (w, h), (wide, high) = one[name].image_size_px, other[name].image_size_px
            raise BadInput(
                args.other, f"{name} has images of {wide} x {high} pixels, in {args.one} {w} x {h}"
            )
    return {name: (one[name], other[name]) for name in both}


def _cameras(path: Path) -> dict[str, CameraEntry]:
    return {camera.name: camera for camera in camera_file(path, read_mapping(path)).cameras}


def _report(one: CameraEntry, other: CameraEntry, difference: ImageMap) -> dict[str, Any]:
    both, length_px = (one, other), difference.length_px
    known = np.isfinite(length_px)
    report: dict[str, Any] = {
        "rms_px": np.nan,
        "largest_px": np.nan,
        "largest_at_px": [0, 0],
        "undrawn_percent": float(100 * np.mean(~known)),
        "focal_px": [list(camera.focal_px) for camera in both],
        "center_px": [list(camera.center_px) for camera in both],
    }
    if known.any():
        most = np.unravel_index(np.nanargmax(length_px), length_px.shape)
        report |= {
            "rms_px": float(np.sqrt(np.mean(length_px[known] ** 2))),
            "largest_px": float(length_px[most]),
            "largest_at_px": difference.pixels[most].tolist(),
        }
    return report
