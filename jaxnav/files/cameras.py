"""Calibrated cameras, read from the files of several calibration tools.

The formats are jaxnav's own rig YAML, Kalibr's camchain, ROS's camera_info YAML, OpenCV's
FileStorage YAML (as its calibration sample and most scripts write it) and PhotonVision's JSON. A
file's keys tell its format.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from jaxnav.core.models.camera import Camera
from jaxnav.errors import BadInput
from jaxnav.files import kalibr
from jaxnav.files.figures import CameraFigures
from jaxnav.files.matrix_cameras import (
    CameraInfo,
    MatrixCamera,
    OpenCVCamera,
    PhotonVisionCamera,
)
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import RigFile, rig_left_out
from jaxnav.files.validation import validate

ImageSizePx = tuple[int, int]  # width, height
CameraFormat = Literal["jaxnav", "kalibr", "ros", "opencv", "photonvision"]


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file, with its format and the keys that were not read.

    Attributes:
        cameras: under the names that the file gives them, at least one.
        left_out: keys with values that no other file can be given.
    """

    format: CameraFormat
    cameras: tuple[CameraFigures, ...]
    left_out: tuple[str, ...]


_ONE_CAMERA: dict[CameraFormat, type[MatrixCamera]] = {
    "photonvision": PhotonVisionCamera,
    "ros": CameraInfo,
    "opencv": OpenCVCamera,
}


def load_camera(path: str | Path, name: str | None = None) -> tuple[Camera, ImageSizePx]:
    """Read one camera and the size of its images in pixels (width, height).

    Args:
        path: a calibration file.
        name: of the camera to read, where the file holds several.

    Raises:
        BadInput: one line naming file and key; with the names to choose from where there are
            several cameras.
    """
    figures = load_figures(Path(path), name)
    return figures.camera(), figures.image_size_px


def load_figures(path: Path, name: str | None) -> CameraFigures:
    """Read the figures of one camera; the arguments and errors are those of `load_camera`."""
    data = read_mapping(path)
    file = camera_file(path, data)
    if file.format in ("jaxnav", "kalibr"):
        return choose_camera(path, file.cameras, name)
    if name is not None and name != data.get("camera_name"):
        raise BadInput(path, f"holds one camera, and it is not named {name!r}")
    return file.cameras[0]


def camera_file(path: Path, data: dict[str, Any], by_topic: bool = False) -> CameraFile:
    """All cameras of a file, whichever tool wrote it.

    Cameras of a camchain are called `cam0`, `cam1` and so on; a camera without a name in its file
    is called after the file.

    Args:
        data: the content of the file.
        by_topic: whether a camchain's cameras are named after their topics instead, if they can be.

    Raises:
        BadInput: one line naming file and key.
    """
    if "cameras" in data:
        rig = validate(RigFile, data, path)
        cameras = tuple(entry.figures() for entry in rig.cameras)
        return CameraFile("jaxnav", cameras, tuple(rig_left_out(rig)))
    if kalibr.is_camchain(data):
        chain = kalibr.camchain(path, data)
        left_out = kalibr.camchain_left_out(data, chain)
        names = kalibr.names_by_topic(chain) if by_topic else list(chain)
        figures = zip(kalibr.camchain_figures(chain), names, strict=True)
        cameras = tuple(replace(camera, name=name) for camera, name in figures)
        return CameraFile("kalibr", cameras, tuple(left_out))
    for tool, model in _ONE_CAMERA.items():
        if data.keys() & set(model.told_by):
            stored = validate(model, data, path)
            camera = stored.figures(path, _name(data.get("camera_name")) or path.stem)
            return CameraFile(tool, (camera,), tuple(stored.left_out(data)))
    raise BadInput(
        path,
        "is no camera file that jaxnav knows: expected a rig (`cameras:`), a Kalibr camchain "
        "(`cam0:`), ROS's camera_info (`distortion_model:`), OpenCV's FileStorage "
        "(`camera_matrix:`) or PhotonVision's JSON (`cameraIntrinsics`)",
    )


def _name(named: Any) -> str:
    """A tool's name of a camera, which may be a serial number; empty where it is not usable."""
    name = str(named) if isinstance(named, str | int) else ""
    return name if len(name) <= 100 and name.isprintable() else ""


def choose_camera(
    path: Path, cameras: tuple[CameraFigures, ...], name: str | None
) -> CameraFigures:
    """The camera of a name, or the only one.

    Raises:
        BadInput: no camera has that name, or there are several and no name is given.
    """
    named = {camera.name: camera for camera in cameras}
    if name is None and len(cameras) == 1:
        return cameras[0]
    if name in named:
        return named[name]
    problem = "holds several cameras" if name is None else f"has no camera {name!r}"
    raise BadInput(path, f"{problem}: choose one of {', '.join(named)}")
