"""Open recordings of any format: a TagSLAM folder, a bag, an .npz, a drive of our own."""

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float, Int

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.interfaces import Odometry
from jaxnav.errors import BadInput
from jaxnav.files.topics import TopicMap
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_replay import check_inputs
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.bags import is_ros1_bag
from jaxnav.recordings.other.decoded import read_decoded
from jaxnav.recordings.other.recording import (
    Recording,
    Reference,
    Source,
    assemble,
    check_winding,
    rows_of,
)
from jaxnav.recordings.other.ros import read_ros_rig
from jaxnav.recordings.other.tagslam import read_detection_bag, read_tagslam

__all__ = ["Recording", "Reference", "read_recording"]


def read_recording(
    path: str | Path,
    rig: CameraRig | None = None,
    markers: MarkerMap | None = None,
    topics: TopicMap | None = None,
) -> Recording:
    """Read a recording.

    Args:
        path: a TagSLAM folder, a .bag or .bag.bz2, or an .npz.
        rig: needed with a bag; replaces the recorded one otherwise.
        markers: the same for the marker map.
        topics: which topic of a ROS bag, of ROS 1 or 2, is what; needs a rig and markers.

    Raises:
        BadInput: one line naming the file and what is wrong in it, or the flag that is missing.
    """
    path = Path(path)
    of_ros = topics is not None or (is_ros1_bag(path) and path.is_file())
    if of_ros and rig is None:
        _no_rig(path)
    if of_ros and markers is None:
        _no_markers(path)  # before all of it is read
    if topics is not None:
        assert rig is not None
        assert markers is not None
        return assemble(path, read_ros_rig(path, topics, rig, markers))
    return assemble(path, open_recording(path, rig), markers)


def open_recording(path: Path, rig: CameraRig | None = None, drives: bool = False) -> Source:
    """Read all detections of a recording, of markers in any map or none.

    Args:
        rig: replaces the recording's own; a bag has none.
        drives: whether drives of our own are read too.

    Raises:
        BadInput: one line naming the file, or the flag that is missing.
    """
    if path.is_dir():
        return read_tagslam(path, rig)
    if not path.exists():
        raise BadInput(path, "there is no such file or folder")
    if path.suffix == ".npz":
        return read_decoded(path, rig)
    if is_ros1_bag(path):
        return read_detection_bag(path, rig or _no_rig(path), lambda: _no_markers(path))
    if path.suffix == ".mcap" and drives:
        return _open_drive(path, rig)
    also = "a .mcap, " if drives else ""
    problem = f"is no recording: expected {also}a folder, a .bag, a .bag.bz2 or an .npz"
    raise BadInput(path, problem)


@dataclass(frozen=True)
class RecordedSightings:
    """N sightings of markers in the order of their frames.

    Attributes:
        rig: the given cameras, or the recording's.
        markers: the map in a drive of our own; None without one.
        stamps_ns: (F,) of the frames, increasing.
        frame, camera, ids: (N,).
        corners_px: (N, 4, 2), TL TR BR BL.
        families: (N,) texts; None where the recording does not tell.
        odometry: readings of a drive, in the order in which they came.
    """

    rig: CameraRig
    markers: MarkerMap | None
    stamps_ns: Int[np.ndarray, " F"]
    frame: Int[np.ndarray, " N"]
    camera: Int[np.ndarray, " N"]
    ids: Int[np.ndarray, " N"]
    corners_px: Float[np.ndarray, "N 4 2"]
    families: tuple[str, ...] | None
    odometry: tuple[Odometry, ...]


def read_sightings(path: str | Path, rig: CameraRig | None = None) -> RecordedSightings:
    """Read a drive (.mcap), a TagSLAM folder, a .bag of detections or an .npz.

    Args:
        rig: replaces the recording's own.

    Raises:
        BadInput: one line naming the file and what is wrong in it, or the flag that is missing.
    """
    path = Path(path)
    source = open_recording(path, rig, drives=True)
    rows = source.rows
    check_winding(path, rows.corners_px)
    named = np.array(rows.families if rows.families is not None else [""] * len(rows.ids), str)
    kept = rows.reliable(rows.ids, named)
    stamps_ns = np.unique(rows.stamps_ns)
    return RecordedSightings(
        source.rig,
        source.markers() if path.suffix == ".mcap" else None,
        stamps_ns,
        np.searchsorted(stamps_ns, rows.stamps_ns[kept]),
        rows.cameras[kept],
        rows.ids[kept],
        rows.corners_px[kept],
        None if rows.families is None else tuple(named[kept].tolist()),
        source.readings,
    )


def _open_drive(path: Path, rig: CameraRig | None) -> Source:
    log = read_drive(path)
    setup = DriveSetup.from_header(log.header, path)
    check_inputs(log.inputs, setup, path)
    if rig is not None and len(rig) != len(setup.rig):
        raise BadInput("--rig", f"has {len(rig)} cameras, but {path} has {len(setup.rig)}")
    tables = []
    frame_stamps_ns = []
    for given in log.inputs:
        seen = [(one, one.detections) for one in given.frames if one.detections is not None]
        if not seen:
            continue
        # Cameras that looked at the same time reach the pilot together: they are one frame.
        stamp_ns = max(one.stamp_ns for one, _ in seen)
        frame_stamps_ns.append(stamp_ns)
        tables += [(stamp_ns, one.camera, found) for one, found in seen]
    readings = (given.odometry for given in log.inputs)
    return Source(
        path.name,
        rows_of(tables, frame_stamps_ns),
        rig or setup.rig,
        lambda: setup.markers,
        readings=tuple(one for one in readings if isinstance(one, Odometry)),
    )


def _no_rig(path: Path) -> NoReturn:
    raise BadInput("--rig", f"missing: {path} alone does not say what its cameras are")


def _no_markers(path: Path) -> NoReturn:
    raise BadInput("--markers", f"missing: {path} does not say where its markers are")
