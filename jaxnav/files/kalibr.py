"""Reading and writing Kalibr's camchain YAML, with imu := vehicle.

`T_cam_imu` maps vehicle to camera. A camera without one is chained from the camera before it by
`T_cn_cnm1`; OpenVINS's inverse, `T_imu_cam`, is read too. A chain that Kalibr made of cameras alone
places none of them on a vehicle.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from jaxnav.core.models.rig import PLACED_BY_CALIBRATION
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.ranges import pinhole_problem, placed_within
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, CameraSigma, Lens, coefficients_problem, pose_entry
from jaxnav.files.validation import (
    Coefficient,
    ForeignEntry,
    ImageSize,
    Matrix,
    MountMatrix,
    Number,
    QuaternionPose,
    Text,
    Wrong,
    at,
    unread_keys,
    validate,
)
from jaxnav.files.writing import yaml_text

_LENS: dict[str, Lens] = {
    "radtan": "radtan",
    "plumb_bob": "radtan",  # TagSLAM's, which may have k3
    "equidistant": "equidistant",
    "equi": "equidistant",
    "none": "none",
}
# Camera models that are lenses: what precedes fu fv pu pv in their intrinsics are coefficients.
_SPHERES: dict[str, Lens] = {"omni": "omni", "ds": "double_sphere", "eucm": "eucm"}
_LEADING = {"pinhole": (), "omni": ("xi",), "ds": ("xi", "alpha"), "eucm": ("alpha", "beta")}
_BENT_BY = {
    "pinhole": tuple(_LENS),
    "omni": ("radtan", "plumb_bob", "none"),
    "ds": ("none",),
    "eucm": ("none",),
}
_CAMERA_KEY = re.compile(r"cam(0|[1-9][0-9]?)")
_TOPIC = re.compile(r"/([^/].*)/image_raw")  # of the camera of that name


class KalibrCamera(ForeignEntry):
    """One `camN` of a camchain."""

    camera_model: Literal["pinhole", "omni", "ds", "eucm"]
    intrinsics: list[Number]
    distortion_model: Text = "none"
    distortion_coeffs: list[Coefficient] = Field(default_factory=list)
    resolution: ImageSize
    T_cam_imu: MountMatrix | None = None
    T_imu_cam: MountMatrix | None = None
    T_cn_cnm1: Annotated[Matrix, placed_within("baseline_m")] | None = None
    rostopic: Text | None = None
    tagtopic: Text | None = None  # TagSLAM's: where the detections of this camera are published
    rig_body: Text | None = None  # TagSLAM's: the body that carries it

    @model_validator(mode="after")
    def _agrees(self) -> "KalibrCamera":
        model, leading = self.camera_model, _LEADING[self.camera_model]
        if len(self.intrinsics) != len(leading) + 4:
            expected = " ".join([*leading, "fu fv pu pv"])
            problem = f"must be {expected}, got {len(self.intrinsics)} numbers"
            raise Wrong("intrinsics", problem)
        *coefficients, fu, fv, _, _ = self.intrinsics
        if min(fu, fv) <= 0:
            raise Wrong("intrinsics", f"the focal lengths must be > 0, got {[fu, fv]}")
        if leading and (wrong := coefficients_problem(_SPHERES[model], coefficients)):
            raise Wrong("intrinsics", wrong)
        if (bent_by := self.distortion_model) not in (known := _BENT_BY[model]):
            of_which = "" if model == "pinhole" else f" for camera_model {model}"
            problem = f"must be one of {', '.join(known)}{of_which}, got {bent_by!r}"
            raise Wrong("distortion_model", problem)
        # Kalibr writes four coefficients for both lenses; for `none` some tools write zeros.
        count, lens = len(self.distortion_coeffs), _LENS[bent_by]
        if lens == "none" and any(self.distortion_coeffs):
            raise Wrong("distortion_coeffs", "must be empty for distortion_model none")
        allowed = {"none": [count], "radtan": [4, 5], "equidistant": [4]}[lens]
        allowed = allowed[:1] if model == "omni" else allowed
        if count not in allowed:
            problem = f"must have {' or '.join(map(str, allowed))} numbers, got {count}"
            raise Wrong("distortion_coeffs", problem)
        if wrong := pinhole_problem(self.intrinsics[-4:], self.resolution):
            raise ValueError(f"intrinsics, resolution: {wrong}")
        return self

    def camera(
        self, name: str, T_camera_vehicle: QuaternionPose | list[list[float]] | None = None
    ) -> CameraEntry:
        """The camera under a given name at a given place, which Kalibr has calibrated."""
        bend = _LENS[self.distortion_model]
        placed = None if T_camera_vehicle is None else CameraSigma.from_place(PLACED_BY_CALIBRATION)
        return CameraEntry.create(
            name,
            _SPHERES.get(self.camera_model, bend),
            self.intrinsics[-4:],
            [*self.intrinsics[:-4], *(() if bend == "none" else self.distortion_coeffs)],
            self.resolution,
            T_camera_vehicle=T_camera_vehicle,
            sigma=placed,
        )


def is_camchain(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like a camchain."""
    return any(_CAMERA_KEY.fullmatch(key) for key in data)


def camchain(path: Path, data: dict[str, Any] | None = None) -> dict[str, KalibrCamera]:
    """The cameras of a camchain file in the order of their numbers.

    Raises:
        BadInput: one line naming file and key.
    """
    data = read_mapping(path) if data is None else data
    keys = sorted((key for key in data if _CAMERA_KEY.fullmatch(key)), key=lambda k: int(k[3:]))
    if not keys:
        raise BadInput(path, "has no camera (`cam0:`)")
    for number, key in enumerate(keys):
        if key != f"cam{number}":
            raise BadInput(at(path, f"cam{number}"), f"missing, though there is {keys[-1]}")
    return {key: validate(KalibrCamera, data[key], path, key) for key in keys}


def camchain_cameras(
    chain: dict[str, KalibrCamera], names: Sequence[str] | None = None
) -> list[CameraEntry]:
    """The cameras, `cam0` first, under their keys or other names; some may have no place."""
    cameras: list[CameraEntry] = []
    for name, entry in zip(names or list(chain), chain.values(), strict=True):
        before = cameras[-1].T_camera_vehicle if cameras else None
        place: Any = entry.T_cam_imu
        if place is None and entry.T_imu_cam is not None:
            place = pose_entry(poses.inverse(poses.pose_from_matrix(entry.T_imu_cam)))
        elif place is None and entry.T_cn_cnm1 is not None and before is not None:
            step = poses.pose_from_matrix(entry.T_cn_cnm1)
            place = pose_entry(poses.compose(step, poses.pose_as_read(before)))
        cameras.append(entry.camera(name, place))
    return cameras


def names_by_topic(chain: dict[str, KalibrCamera]) -> list[str]:
    """The names of the cameras by `rostopic`, or their keys where that gives no distinct names.

    `/front/image_raw` gives the name `front`; any other topic is the name itself.
    """
    names = [
        _name_of(entry.rostopic) if entry.rostopic and entry.rostopic.isprintable() else key
        for key, entry in chain.items()
    ]
    return names if len(set(names)) == len(names) else list(chain)


def names_by_tag_topic(chain: dict[str, KalibrCamera]) -> list[str]:
    """The names of the cameras by TagSLAM's `tagtopic`, or their keys."""
    return [entry.tagtopic or key for key, entry in chain.items()]


def camchain_left_out(data: dict[str, Any], chain: dict[str, KalibrCamera]) -> list[str]:
    """The keys that are not read and not empty, see `unread_keys`."""
    unread = unread_keys(data, list(chain))
    read = set(KalibrCamera.model_fields) - {"tagtopic", "rig_body"}
    for key, camera in zip(chain, camchain_cameras(chain), strict=True):
        unplaced = {"T_cn_cnm1"} if camera.T_camera_vehicle is None else set()
        unread += unread_keys(data[key], sorted(read - unplaced), f"{key}.")
    return unread


def camchain_text(cameras: Sequence[CameraEntry]) -> str:
    """The cameras as the text of a camchain; a single camera may have no place.

    Raises:
        BadInput: a lens that Kalibr does not know, or one of several cameras without a place.
    """
    data: dict[str, Any] = {}
    Ts: list[np.ndarray] = []  # (4, 4)
    for index, camera in enumerate(cameras):
        where = f"--to kalibr: {camera.name}"
        entry: dict[str, Any] = {"cam_overlaps": [], **_lens_entry(where, camera)}
        if camera.T_camera_vehicle is not None:
            Ts.append(poses.matrix_as_read(camera.T_camera_vehicle))
            entry["T_cam_imu"] = Ts[-1].tolist()
        elif len(cameras) > 1:
            raise BadInput(where, "has no place on the vehicle: write T_cam_imu into the source")
        if index:
            entry["T_cn_cnm1"] = (
                Ts[-1] @ poses.matrix(poses.inverse(poses.pose_from_matrix(Ts[-2])))
            ).tolist()
        data[f"cam{index}"] = entry | {
            "resolution": list(camera.image_size_px),
            "rostopic": _topic_of(where, camera.name),
        }
    return yaml_text(data)


def _lens_entry(where: str, camera: CameraEntry) -> dict[str, Any]:
    """What a camchain says of a camera's lens."""
    coefficients = list(camera.distortion)
    model = next((key for key, lens in _SPHERES.items() if lens == camera.lens), "pinhole")
    leading, bend = coefficients[: len(_LEADING[model])], coefficients[len(_LEADING[model]) :]
    if model == "pinhole" and camera.lens not in _LENS:
        known = ", ".join(["radtan", "equidistant", *list(_SPHERES.values())[:-1]])
        raise BadInput(
            f"{where}.lens",
            f"is {camera.lens}, and Kalibr has {known} and eucm: calibrate again with one",
        )
    if camera.lens == "radtan" and bend.pop():
        raise BadInput(
            f"{where}.distortion",
            "has k3, and Kalibr's radtan is k1 k2 p1 p2: calibrate again without k3",
        )
    bent_by = "radtan" if model == "omni" else "none"
    return {
        "camera_model": model,
        "distortion_coeffs": bend,
        "distortion_model": camera.lens if model == "pinhole" else bent_by,
        "intrinsics": [*leading, *camera.focal_px, *camera.center_px],
    }


def _name_of(topic: str) -> str:
    of_camera = _TOPIC.fullmatch(topic)
    return of_camera[1] if of_camera else topic


def _topic_of(where: str, name: str) -> str:
    topic = name if name.startswith("/") else f"/{name}/image_raw"
    if _name_of(topic) != name:
        raise BadInput(where, "has a name that stands for a topic of another camera: rename it")
    return topic
