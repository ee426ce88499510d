"""Calibrated cameras and rigs, read from the files of several calibration tools.

The formats are jaxnav's own rig YAML, Kalibr's camchain, ROS's camera_info YAML, OpenCV's
FileStorage YAML (as its calibration sample and most scripts write it) and PhotonVision's JSON. A
file's keys tell its format.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.files import kalibr
from jaxnav.files.matrix_cameras import ONE_CAMERA_FORMATS
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, RigFile, rig_left_out, rig_of
from jaxnav.files.validation import at, validate


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file, with its format and the keys that were not read.

    Attributes:
        cameras: under the names that the file gives them, at least one; placed by
            `T_camera_vehicle` or not at all.
        left_out: keys with values that no other file can be given.
    """

    format: Literal["jaxnav", "kalibr", "ros", "opencv", "photonvision"]
    cameras: tuple[CameraEntry, ...]
    left_out: tuple[str, ...]


def load_rig(path: str | Path) -> CameraRig:
    """Read a camera rig from jaxnav's own YAML, or a Kalibr camchain with imu := vehicle.

    Raises:
        BadInput: one line naming file and key.
    """
    path = Path(path)
    data = read_mapping(path)
    if "cameras" not in data and not kalibr.is_camchain(data):
        raise BadInput(path, "is neither a rig (`cameras:`) nor a Kalibr camchain (`cam0:`)")
    cameras = camera_file(path, data, kalibr.names_by_tag_topic).cameras
    for index, camera in enumerate(cameras):
        if camera.T_camera_vehicle is None:
            problem = "missing: where is this camera on the vehicle (imu := vehicle)?"
            raise BadInput(at(path, f"cam{index}", "T_cam_imu"), problem)
    return rig_of(cameras)


def load_camera(path: str | Path, name: str | None = None) -> tuple[Camera, tuple[int, int]]:
    """Read one camera and the size of its images in pixels (width, height).

    Args:
        path: a calibration file.
        name: of the camera to read, where the file holds several.

    Raises:
        BadInput: one line naming file and key; with the names to choose from where there are
            several cameras.
    """
    entry = load_camera_entry(Path(path), name)
    return entry.camera(), entry.size_px


def load_camera_entry(path: Path, name: str | None) -> CameraEntry:
    """Read one camera with its name and sigmas; arguments and errors as of `load_camera`."""
    return choose_camera(path, camera_file(path, read_mapping(path)).cameras, name)


def camera_file(
    path: Path,
    data: dict[str, Any],
    camchain_names: Callable[[dict[str, kalibr.KalibrCamera]], Sequence[str]] = list,
) -> CameraFile:
    """All cameras of a file, whichever tool wrote it.

    A camera without a name in its file is called after the file.

    Args:
        data: the content of the file.
        camchain_names: names the cameras of a camchain; by default `cam0`, `cam1` and so on.

    Raises:
        BadInput: one line naming file and key.
    """
    if "cameras" in data:
        rig = validate(RigFile, data, path)
        cameras = tuple(entry.placed() for entry in rig.cameras)
        return CameraFile("jaxnav", cameras, tuple(rig_left_out(rig)))
    if kalibr.is_camchain(data):
        chain = kalibr.camchain(path, data)
        cameras = tuple(kalibr.camchain_cameras(chain, camchain_names(chain)))
        return CameraFile("kalibr", cameras, tuple(kalibr.camchain_left_out(data, chain)))
    for tool, model in ONE_CAMERA_FORMATS.items():
        if data.keys() & set(model.format_keys):
            stored = validate(model, data, path)
            camera = stored.camera(_name(data.get("camera_name")) or path.stem)
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


def choose_camera(path: Path, cameras: tuple[CameraEntry, ...], name: str | None) -> CameraEntry:
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
