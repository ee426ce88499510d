"""Cameras as OpenCV's functions take them and most tools write them: K, row by row, and D."""

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from jaxnav.errors import BadInput
from jaxnav.files.figures import CameraFigures, Lens
from jaxnav.files.ranges import pinhole_problem, problem_of
from jaxnav.files.validation import Count, ForeignEntry, Number, show_value
from jaxnav.models.camera import LENS_COEFFICIENTS


class MatrixEntry(ForeignEntry):
    """A matrix as ROS, OpenCV and PhotonVision write it.

    OpenCV 5 writes a vector with `sizes` alone.
    """

    rows: Count
    cols: Count
    data: Annotated[list[Number], Field(max_length=64)]

    @model_validator(mode="before")
    @classmethod
    def _a_vector(cls, entry: Any) -> Any:
        if isinstance(entry, dict) and "rows" not in entry and "sizes" in entry:
            sizes = entry["sizes"]
            if not isinstance(sizes, list) or len(sizes) != 1:
                raise ValueError(f"sizes: must be one number, got {show_value(sizes)}")
            return {**entry, "rows": sizes[0], "cols": 1}
        return entry

    @field_validator("data")
    @classmethod
    def _complete(cls, data: list[float], info: Any) -> list[float]:
        rows, cols = info.data.get("rows"), info.data.get("cols")
        if rows is not None and cols is not None and rows * cols != len(data):
            raise ValueError(f"must have {rows} x {cols} numbers, got {len(data)}")
        return data


def figures_from_matrices(
    name: str,
    image_size_px: Sequence[int],
    matrix: tuple[str, Sequence[float]],
    distortion: tuple[str, Sequence[float]],
    lens: Lens,
) -> CameraFigures:
    """A camera from K and the lens's coefficients; each comes with its key in the file.

    Raises:
        BadInput: not calibrated, skewed, or a lens with more coefficients than ours.

    Returns:
        The camera; a `radtan` lens with more than five coefficients that matter is `rational`.
    """
    where, K = matrix
    if len(K) != 9:
        raise BadInput(where, f"must be 3 x 3, got {len(K)} numbers")
    if K[0] == 0:
        raise BadInput(f"{where}[0]", "is 0: this camera has not been calibrated")
    for index in (0, 4):
        if K[index] <= 0:
            raise BadInput(f"{where}[{index}]", f"the focal length must be > 0, got {K[index]:g}")
    if any(abs(K[index]) > 1e-9 * K[0] for index in (1, 3, 6, 7)) or K[8] != 1:
        raise BadInput(where, "must be fx 0 cx, 0 fy cy, 0 0 1 (no skew)")
    pinhole_px = [K[index] for index in (0, 4, 2, 5)]
    if problem := pinhole_problem(pinhole_px, image_size_px):
        sizes = "image_width and image_height, or resolution"
        raise BadInput(where, f"{problem} ({sizes})")
    where, coefficients = distortion
    if lens == "radtan" and any(coefficients[5:]):
        lens = "rational"
    most = LENS_COEFFICIENTS[lens]
    if lens == "equidistant" and len(coefficients) != 4:
        raise BadInput(where, f"must be k1 k2 k3 k4 for a fisheye lens, got {len(coefficients)}")
    if any(coefficients[most:]):
        raise BadInput(
            where, "has thin prism or tilt coefficients that are not zero: calibrate again with "
            "eight (rational) or five (plumb_bob, radtan)",
        )  # fmt: skip
    for index, value in enumerate(coefficients[:most]):
        if problem := problem_of("distortion", value):
            raise BadInput(f"{where}[{index}]", problem)
    return CameraFigures.create(name, lens, pinhole_px, coefficients[:most], image_size_px)


def pinhole_matrix(camera: CameraFigures) -> list[float]:
    """K of a camera, 9 numbers row by row."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.center_px
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def coefficients(camera: CameraFigures) -> list[float]:
    """D of a camera: k1 k2 p1 p2 k3 [k4 k5 k6], k1 k2 k3 k4 of a fisheye, zeros without a lens."""
    return list(camera.distortion) if camera.lens != "none" else [0.0] * 5
