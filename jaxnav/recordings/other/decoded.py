"""Read decoded TagSLAM recordings: one .npz with a row for each detection."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.core.models.conventions import APRILTAG_CORNERS
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import PLACED_BY_CALIBRATION, CameraRig
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.markers import marker_map
from jaxnav.files.ranges import is_within, pinhole_problem, problem_of
from jaxnav.files.rigs import CameraEntry, CameraSigma, coefficients_problem, pose_entry, rig_of
from jaxnav.files.unpacking import read_npz
from jaxnav.recordings.other.recording import TO_OURS, Rows, Source

# key -> shape, whose letters are sizes that must agree; kind (i: whole numbers, f: numbers, U:
# text); and the quantity in `RANGES` of its numbers, or of the translations of its poses
_KEYS: dict[str, tuple[tuple[str | int, ...], str, str | None]] = {
    "stamp_ns": (("N",), "i", "stamp_ns"),
    "cam": (("N",), "i", None),
    "tag_id": (("N",), "i", "id"),
    "corners_px": (("N", 4, 2), "f", None),
    "cam_names": (("C",), "U", None),
    "K": (("C", 4), "f", None),
    "dist": (("C", 5), "f", "distortion"),
    "dist_model": (("C",), "U", None),
    "T_rig_cam": (("C", 4, 4), "f", "position_m"),
    "map_ids": (("M",), "i", "id"),
    "map_size": (("M",), "f", None),
    "T_map_tag": (("M", 4, 4), "f", "position_m"),
    # A recording with one of these has a reference.
    "rig_stamp": (("R",), "i", "stamp_ns"),
    "T_map_rig": (("R", 4, 4), "f", "position_m"),
}
_REFERENCE = {"rig_stamp", "T_map_rig"}
_KINDS = {"i": ("whole numbers", "iu"), "f": ("numbers", "fiu"), "U": ("text", "U")}
_Stored = dict[str, np.ndarray]


def read_decoded(path: Path, rig: CameraRig | None) -> Source:
    """Read an .npz, which may have no reference.

    The file does not hold the sizes of the images: they are taken as twice the principal point,
    or larger where a corner lies further out.

    Raises:
        BadInput: one line naming file and key.
    """
    try:
        stored = dict(read_npz(path, _KEYS.keys() | {"obj_order"}))
    except BadInput:
        raise
    except Exception as error:
        # NumPy, zipfile and zlib may meet any bytes, and raise whatever they lead to.
        problem = f"is not a readable .npz file ({type(error).__name__}: {error})"
        raise BadInput(path, problem) from None
    _check(path, stored)
    cameras = len(stored["cam_names"])
    if rig is not None and len(rig) != cameras:
        raise BadInput("--rig", f"has {len(rig)} cameras, but {path} has {cameras}")
    stamps_ns = stored["stamp_ns"].astype(np.int64)
    rows = Rows(
        stamps_ns=stamps_ns,
        cameras=stored["cam"].astype(np.int64),
        ids=stored["tag_id"].astype(np.int64),
        corners_px=stored["corners_px"].astype(float)[:, TO_OURS],
        frame_stamps_ns=np.unique(stamps_ns),
    )
    name = path.stem if path.stem != "decoded" else path.resolve().parent.name
    return Source(
        name,
        rows,
        rig or _rig(path, stored),
        lambda: _markers(path, stored),
        lambda: _reference(path, stored),
    )


def _check(path: Path, stored: _Stored) -> None:
    sizes: dict[str, tuple[str, int]] = {}
    for key, (shape, kind, quantity) in _KEYS.items():
        if key in _REFERENCE and not _REFERENCE & stored.keys():
            continue
        where = f"{path}: {key}"
        if key not in stored:
            raise BadInput(where, "missing")
        value, (words, kinds) = stored[key], _KINDS[kind]
        expected = "(" + ", ".join(str(size) for size in shape) + ")"
        if value.ndim != len(shape):
            raise BadInput(where, f"must have the shape {expected}, got {value.shape}")
        if value.dtype.kind not in kinds:
            raise BadInput(where, f"must hold {words}, got {value.dtype}")
        for size, got in zip(shape, value.shape, strict=True):
            other, known = (
                sizes.setdefault(size, (key, got)) if isinstance(size, str) else ("", size)
            )
            if got != known:
                because = f", for {other} has {size} = {known}" if other else ""
                raise BadInput(where, f"must have the shape {expected}{because}, got {value.shape}")
        if kind == "f" and key != "corners_px" and not np.isfinite(value).all():
            raise BadInput(where, "must be finite")
        if quantity is not None:
            values = value[:, :3, 3] if key.startswith("T_") else value
            inside = is_within(quantity, values)
            if not inside.all():
                place = tuple(int(i) for i in np.argwhere(~inside)[0])
                at = "".join(f"[{i}]" for i in place)
                raise BadInput(f"{where}{at}", str(problem_of(quantity, values[place].item())))
    for letter, what in (("C", "camera"), ("M", "marker")):
        if sizes[letter][1] == 0:
            raise BadInput(f"{path}: {sizes[letter][0]}", f"has no {what}")
    if "obj_order" in stored and not np.array_equal(stored["obj_order"], APRILTAG_CORNERS):
        raise BadInput(f"{path}: obj_order", "must be (-,-) (+,-) (+,+) (-,+)")
    for index, name in enumerate(stored["cam_names"]):
        if not (0 < len(name) <= 100 and str(name).isprintable()):
            raise BadInput(f"{path}: cam_names[{index}]", f"must be a name, got {str(name)!r:.40}")
    cam, cameras = stored["cam"], len(stored["cam_names"])
    if cam.size and not 0 <= cam.min() <= cam.max() < cameras:
        raise BadInput(f"{path}: cam", f"must be from 0 to {cameras - 1}")


def _poses(path: Path, key: str, stored: _Stored) -> list[np.ndarray]:
    found = []
    for index, T in enumerate(stored[key]):
        try:
            poses.check_matrix(T.tolist())
        except ValueError as error:
            raise BadInput(f"{path}: {key}[{index}]", str(error)) from None
        found.append(poses.pose_from_matrix(T))
    return found


def _reference(path: Path, stored: _Stored) -> dict[int, np.ndarray] | None:
    if "rig_stamp" not in stored:
        return None
    stamps_ns = map(int, stored["rig_stamp"])
    return dict(zip(stamps_ns, _poses(path, "T_map_rig", stored), strict=True))


def _rig(path: Path, stored: _Stored) -> CameraRig:
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
        wrong = pinhole_problem(K.tolist(), size_px.tolist())
        if not is_within("image_px", size_px).all():
            wrong = f"the principal point {K[2:]} is of no image that there is"
        if wrong is not None:
            raise BadInput(f"{path}: K[{index}]", wrong)
        name = str(stored["cam_names"][index])
        cameras.append(CameraEntry.create(name, lens, K, distortion[:count], size_px))
    sigma = CameraSigma.from_place(PLACED_BY_CALIBRATION)
    return rig_of(
        [
            camera.model_copy(
                update={"T_camera_vehicle": pose_entry(poses.inverse(T)), "sigma": sigma}
            )
            for camera, T in zip(cameras, _poses(path, "T_rig_cam", stored), strict=True)
        ]
    )


def _markers(path: Path, stored: _Stored) -> MarkerMap:
    sizes_m, ids = stored["map_size"].tolist(), stored["map_ids"].tolist()
    if min(sizes_m) <= 0:
        raise BadInput(f"{path}: map_size", "must be > 0")
    for index, size_m in enumerate(sizes_m):
        if problem := problem_of("size_m", size_m):
            raise BadInput(f"{path}: map_size[{index}]", problem)
    if len(set(ids)) < len(ids):
        raise BadInput(f"{path}: map_ids", "must differ")
    Ts = np.stack(_poses(path, "T_map_tag", stored))
    return marker_map(Ts, sizes_m, ids, ["tag36h11"] * len(ids))
