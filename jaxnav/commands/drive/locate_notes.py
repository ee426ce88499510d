"""Notes of `jaxnav locate`: what a person should know of a photograph before trusting its poses."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxnav.commands.drive.arguments import Locate
from jaxnav.detection import make_detector
from jaxnav.detection.families import LARGEST_FAMILIES
from jaxnav.files.images import MIRRORED

_LARGE_M, _SMALL_M = 1.5, 0.003  # sides that markers rarely have, and other units often make
_MISFIT = 5.0  # sigmas by which corners are off their pose
_FLIP = 0.3  # a larger probability says that both poses are possible
_TURNED_DEG = {3: 180, 4: 180, 5: 90, 6: 90, 7: 270, 8: 270}  # clockwise, by EXIF's number


def notes(
    args: Locate,
    markers: Sequence[dict[str, Any]],
    image: UInt8[np.ndarray, "rows columns *channels"],
    orientation: int,
    knows_lens: bool,
    blurred: bool = False,
) -> list[str]:
    """Sentences on a photograph and the markers found in it.

    Args:
        markers: as in the report.
        orientation: of the photograph, 1 to 8, as EXIF counts.
        knows_lens: whether the camera's file has sigmas of its lens.
        blurred: whether no marker could be read without restoring the photograph.
    """
    said = _of_the_size(args.marker_size_m)
    if orientation != 1:
        turned = f"turned by {_TURNED_DEG[orientation]} deg" if orientation in _TURNED_DEG else ""
        mirrored = "mirrored" if orientation in MIRRORED else ""
        shown = " and ".join(filter(None, (mirrored, turned)))
        said.append(
            f"viewers show this photograph {shown} (EXIF); x (right) and y (down) are those of the "
            "pixels as the camera stored them"
        )
    if not markers:
        said += _other_family(args, image)
    elif blurred:
        said.append(
            "the photograph is blurred by a motion: ids were read in a restored one, and corners "
            "fitted to the photograph as it is"
        )
    said += [
        f"marker {marker['id']}: no pose explains its corners"
        for marker in markers
        if not marker["poses"]
    ]
    said += _of_misfits(markers) + _of_flips(markers)
    ids = [marker["id"] for marker in markers]
    said += [
        f"marker {i} is seen {ids.count(i)} times: at most one of them is the one that you mean"
        for i in sorted({i for i in ids if ids.count(i) > 1})
    ]
    if markers and not knows_lens:
        said.append(
            f"--camera {args.camera.name} has no sigmas of its lens, so sigma (m) leaves out what "
            "its focal length and centre are wrong: `jaxnav calibrate intrinsics` writes them"
        )
    return said


def _of_the_size(size_m: float) -> list[str]:
    if _SMALL_M <= size_m <= _LARGE_M:
        return []
    if size_m > _LARGE_M:
        other = f"{size_m / 1000:g} if {size_m:g} are mm, {size_m / 100:g} if they are cm"
    else:
        other = f"{1000 * size_m:g} if it was divided by 1000 twice"
    return [f"--marker-size-m {size_m:g} is {size_m:g} m: {other}"]


def _other_family(args: Locate, image: np.ndarray) -> list[str]:
    """The family of which the photograph shows most markers instead."""
    seen = {}
    for family in LARGEST_FAMILIES:
        if family != args.family:
            found = make_detector("aruco", family).detect(image)
            seen[family] = found.ids[found.refined]
    family = max(seen, key=lambda one: len(seen[one]))
    if not len(seen[family]):
        return []
    ids = ", ".join(map(str, sorted(set(seen[family].tolist()))[:6]))
    return [f"{len(seen[family])} of {family} in view (id {ids}): --family {family}"]


def _of_misfits(markers: Sequence[dict[str, Any]]) -> list[str]:
    name, worst = _worst(markers, "misfit_sigmas", _MISFIT)
    if worst is None:
        return []
    return [
        f"{name}: corners are {worst['poses'][0]['reprojection_error_px']:.2g} px off the pose, "
        f"{worst['misfit_sigmas']:.0f} of their sigmas, and count as "
        f"{worst['sigma_factor']:.2g} times as unsure: is --camera that of this photograph, with "
        "its zoom and focus, and is the marker flat?"
    ]


def _of_flips(markers: Sequence[dict[str, Any]]) -> list[str]:
    name, worst = _worst(markers, "flip_probability", _FLIP)
    if worst is None:
        return []
    return [
        f"{name}: both poses are possible (P(flip) {worst['flip_probability']:.2f}): take it from "
        "nearer, or more from the side"
    ]


def _worst(
    markers: Sequence[dict[str, Any]], key: str, limit: float
) -> tuple[str, dict[str, Any] | None]:
    """What to call all markers beyond a limit, and the worst of them; None where there is none."""
    beyond = [marker for marker in markers if marker[key] > limit]
    if not beyond:
        return "", None
    worst = max(beyond, key=lambda marker: marker[key])
    if len(beyond) == 1:
        return f"marker {worst['id']}", worst
    return f"{len(beyond)} markers, {worst['id']} most of all", worst
