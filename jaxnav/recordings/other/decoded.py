"""Reading of decoded TagSLAM recordings: one .npz with a row for each detection."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.core.models.conventions import APRILTAG_CORNERS
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import PLACED_BY_CALIBRATION, CameraRig
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.figures import CameraFigures, coefficients_problem, rig_from_figures
from jaxnav.files.markers import marker_map
from jaxnav.files.npz import read_npz
from jaxnav.files.ranges import is_within, pinhole_problem, problem_of
from jaxnav.recordings.other.recording import RecordingSource, Rows

# name -> shape and kind (i: whole numbers, f: numbers, U: text); letters are sizes that must agree
_KEYS: dict[str, tuple[tuple[str | int, ...], str]] = {
    "stamp_ns": (("N",), "i"),
    "cam": (("N",), "i"),
    "tag_id": (("N",), "i"),
    "corners_px": (("N", 4, 2), "f"),
    "cam_names": (("C",), "U"),
    "K": (("C", 4), "f"),
    "dist": (("C", 5), "f"),
    "dist_model": (("C",), "U"),
    "T_rig_cam": (("C", 4, 4), "f"),
    "map_ids": (("M",), "i"),
    "map_size": (("M",), "f"),
    "T_map_tag": (("M", 4, 4), "f"),
}
_REFERENCE_KEYS: dict[str, tuple[tuple[str | int, ...], str]] = {
    "rig_stamp": (("R",), "i"),
    "T_map_rig": (("R", 4, 4), "f"),
}


def read_decoded(path: Path, rig: CameraRig | None) -> RecordingSource:
    """Read an .npz, which may have no reference.

    The file does not hold the sizes of the images: they are taken as twice the principal point,
    or larger where a corner lies further out.

    Raises:
        BadInput: one line naming file and key.
    """
    stored = _checked(path)
    rows, rig = _rows(path, stored, rig)
    name = path.stem if path.stem != "decoded" else path.resolve().parent.name
    return RecordingSource(
        name, rows, rig, lambda: _markers(path, stored), lambda: _reference(path, stored)
    )


def _reference(path: Path, stored: dict[str, np.ndarray]) -> dict[int, np.ndarray] | None:
    if "rig_stamp" not in stored:
        return None
    matrices = zip(stored["rig_stamp"], stored["T_map_rig"], strict=True)
    return {
        int(stamp): _pose(path, f"T_map_rig[{index}]", T)
        for index, (stamp, T) in enumerate(matrices)
    }


def _checked(path: Path) -> dict[str, np.ndarray]:
    try:
        stored = dict(read_npz(path, _KEYS.keys() | _REFERENCE_KEYS.keys() | {"obj_order"}))
    except BadInput:
        raise
    except Exception as error:
        # NumPy, zipfile and zlib may meet any bytes, and raise whatever they lead to.
        problem = f"is not a readable .npz file ({type(error).__name__}: {error})"
        raise BadInput(path, problem) from None
    has_reference = bool(_REFERENCE_KEYS.keys() & stored.keys())
    _check(path, stored, _KEYS | (_REFERENCE_KEYS if has_reference else {}))
    if "obj_order" in stored and not np.array_equal(stored["obj_order"], APRILTAG_CORNERS):
        raise BadInput(f"{path}: obj_order", "must be (-,-) (+,-) (+,+) (-,+)")
    _check_ranges(path, stored)
    return stored


# key -> the quantity in `RANGES` of its numbers, or of the translations of its poses.
_QUANTITIES = {
    "stamp_ns": "stamp_ns",
    "rig_stamp": "stamp_ns",
    "tag_id": "id",
    "map_ids": "id",
    "dist": "distortion",
    "T_rig_cam": "position_m",
    "T_map_tag": "position_m",
    "T_map_rig": "position_m",
}


def _check_ranges(path: Path, stored: dict[str, np.ndarray]) -> None:
    for key, name in _QUANTITIES.items():
        if key not in stored:
            continue
        values = stored[key][:, :3, 3] if key.startswith("T_") else stored[key]
        inside = is_within(name, values)
        if not inside.all():
            place = tuple(int(i) for i in np.argwhere(~inside)[0])
            at = "".join(f"[{i}]" for i in place)
            raise BadInput(f"{path}: {key}{at}", str(problem_of(name, values[place].item())))
    for index, name in enumerate(stored["cam_names"]):
        if not (0 < len(name) <= 100 and str(name).isprintable()):
            raise BadInput(f"{path}: cam_names[{index}]", f"must be a name, got {str(name)!r:.40}")


def _rows(
    path: Path, stored: dict[str, np.ndarray], rig: CameraRig | None
) -> tuple[Rows, CameraRig]:
    cameras = len(stored["cam_names"])
    if stored["cam"].size and not 0 <= stored["cam"].min() <= stored["cam"].max() < cameras:
        raise BadInput(f"{path}: cam", f"must be from 0 to {cameras - 1}")
    if rig is not None and len(rig) != cameras:
        raise BadInput("--rig", f"has {len(rig)} cameras, but {path} has {cameras}")
    stamps_ns = stored["stamp_ns"].astype(np.int64)
    rows = Rows(
        stamps_ns=stamps_ns,
        cameras=stored["cam"].astype(np.int64),
        ids=stored["tag_id"].astype(np.int64),
        corners_px=stored["corners_px"].astype(float),
        frame_stamps_ns=np.unique(stamps_ns),
    )
    return rows, rig or _rig(path, stored)


def _check(path: Path, stored: dict[str, np.ndarray], keys: dict[str, Any]) -> None:
    sizes: dict[str, tuple[str, int]] = {}
    for key, (shape, kind) in keys.items():
        where = f"{path}: {key}"
        if key not in stored:
            raise BadInput(where, "missing")
        value = stored[key]
        expected = "(" + ", ".join(str(size) for size in shape) + ")"
        if value.ndim != len(shape):
            raise BadInput(where, f"must have the shape {expected}, got {value.shape}")
        if value.dtype.kind not in {"i": "iu", "f": "fiu", "U": "U"}[kind]:
            raise BadInput(where, f"must hold {_KINDS[kind]}, got {value.dtype}")
        for size, got in zip(shape, value.shape, strict=True):
            if isinstance(size, int):
                fits, because = got == size, ""
            else:
                other, known = sizes.setdefault(size, (key, got))
                fits, because = got == known, f", for {other} has {size} = {known}"
            if not fits:
                raise BadInput(where, f"must have the shape {expected}{because}, got {value.shape}")
        if kind == "f" and key != "corners_px" and not np.isfinite(value).all():
            raise BadInput(where, "must be finite")
    for letter, what in (("C", "camera"), ("M", "marker")):
        if sizes[letter][1] == 0:
            raise BadInput(f"{path}: {sizes[letter][0]}", f"has no {what}")


_KINDS = {"i": "whole numbers", "f": "numbers", "U": "text"}


def _pose(path: Path, key: str, T: np.ndarray) -> np.ndarray:
    try:
        poses.check_matrix(T.tolist())
    except ValueError as error:
        raise BadInput(f"{path}: {key}", str(error)) from None
    return poses.pose_from_matrix(T)


def _rig(path: Path, stored: dict[str, np.ndarray]) -> CameraRig:
    cameras = []
    for index, (K, distortion) in enumerate(zip(stored["K"], stored["dist"], strict=True)):
        lens: Any = str(stored["dist_model"][index])
        if lens not in LENS_COEFFICIENTS:
            problem = f"must be one of {', '.join(LENS_COEFFICIENTS)}, got {lens!r}"
            raise BadInput(f"{path}: dist_model[{index}]", problem)
        if K[:2].min() <= 0:
            raise BadInput(f"{path}: K[{index}]", f"focal lengths must be > 0, got {K[:2]}")
        count = LENS_COEFFICIENTS[lens]
        if np.any(distortion[count:]):
            raise BadInput(f"{path}: dist[{index}]", f"only the first {count} may differ from zero")
        if wrong := coefficients_problem(lens, distortion.tolist()):
            raise BadInput(f"{path}: dist[{index}]", wrong)
        corners = stored["corners_px"][stored["cam"] == index].reshape(-1, 2)
        inside = is_within("image_px", corners)
        furthest = np.max(corners, axis=0, initial=0, where=inside)
        size_px = np.ceil(np.maximum(2 * K[2:], furthest) + 1)
        if not is_within("image_px", size_px).all():
            problem = f"the principal point {K[2:]} is of no image that there is"
            raise BadInput(f"{path}: K[{index}]", problem)
        wrong = pinhole_problem(K.tolist(), size_px.tolist())
        if wrong is not None:
            raise BadInput(f"{path}: K[{index}]", wrong)
        name = str(stored["cam_names"][index])
        cameras.append(CameraFigures.create(name, lens, K, distortion[:count], size_px))
    Ts = [_pose(path, f"T_rig_cam[{index}]", T) for index, T in enumerate(stored["T_rig_cam"])]
    return rig_from_figures(
        [
            replace(camera, T_camera_vehicle=poses.inverse(T), sigma=PLACED_BY_CALIBRATION)
            for camera, T in zip(cameras, Ts, strict=True)
        ]
    )


def _markers(path: Path, stored: dict[str, np.ndarray]) -> MarkerMap:
    if stored["map_size"].min() <= 0:
        raise BadInput(f"{path}: map_size", "must be > 0")
    for index, size_m in enumerate(stored["map_size"].tolist()):
        if problem := problem_of("size_m", size_m):
            raise BadInput(f"{path}: map_size[{index}]", problem)
    ids = stored["map_ids"].tolist()
    if len(set(ids)) < len(ids):
        raise BadInput(f"{path}: map_ids", "must differ")
    Ts = [_pose(path, f"T_map_tag[{index}]", T) for index, T in enumerate(stored["T_map_tag"])]
    return marker_map(np.stack(Ts), stored["map_size"].tolist(), ids, ["tag36h11"] * len(ids))
