"""Reading of all sightings of markers in a recording, of markers in any map or none."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.interfaces import Odometry
from jaxnav.errors import BadInput
from jaxnav.files.ranges import is_within
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_replay import check_inputs
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recording import TO_OURS, check_winding
from jaxnav.recordings.other.recordings import read_source


@dataclass(frozen=True)
class RecordedSightings:
    """N sightings of markers in the order of their frames.

    Attributes:
        rig: the given cameras, or the recording's.
        markers: the map in the recording; None without one.
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

    A marker that a camera reports twice in a frame is left out there: one of the two is false.

    Args:
        rig: replaces the recording's own.

    Raises:
        BadInput: one line naming the file and what is wrong in it, or the flag that is missing.
    """
    path = Path(path)
    if path.suffix == ".mcap" and path.exists() and not path.is_dir():
        return _of_drive(path, rig)
    source = read_source(path, rig, also="a .mcap, ")
    rows = source.rows
    stamps_ns, frame = np.unique(rows.stamps_ns, return_inverse=True)
    corners_px = rows.corners_px[:, TO_OURS]
    return _once(
        path,
        RecordedSightings(
            source.rig, None, stamps_ns, frame, rows.cameras, rows.ids, corners_px, None, ()
        ),
    )


def _of_drive(path: Path, rig: CameraRig | None) -> RecordedSightings:
    log = read_drive(path)
    setup = DriveSetup.of_header(log.header, path)
    check_inputs(log.inputs, setup, path)
    if rig is not None and len(rig) != len(setup.rig):
        raise BadInput("--rig", f"has {len(rig)} cameras, but {path} has {len(setup.rig)}")
    stamps_ns: list[int] = []
    rows: list[tuple[int, int, int, str]] = []
    corners_px: list[np.ndarray] = []
    # Cameras that looked at the same time reach the pilot together: they are one frame.
    for given in log.inputs:
        seen = [frame for frame in given.frames if frame.detections is not None]
        if not seen:
            continue
        for one in seen:
            detections = one.detections
            assert detections is not None
            for index, marker_id in enumerate(detections.ids):
                family = detections.families[index]
                rows.append((len(stamps_ns), one.camera, int(marker_id), family))
                corners_px.append(detections.corners_px[index])
        stamps_ns.append(max(one.stamp_ns for one in seen))
    frame, camera, ids = (np.array([row[k] for row in rows], int) for k in range(3))
    return _once(
        path,
        RecordedSightings(
            rig=rig or setup.rig,
            markers=setup.markers,
            stamps_ns=np.array(stamps_ns, np.int64),
            frame=frame,
            camera=camera,
            ids=ids,
            corners_px=np.array(corners_px, float).reshape(-1, 4, 2),
            families=tuple(row[3] for row in rows),
            odometry=tuple(
                given.odometry for given in log.inputs if isinstance(given.odometry, Odometry)
            ),
        ),
    )


def _once(path: Path, seen: RecordedSightings) -> RecordedSightings:
    """The sightings with corners in range of markers that a camera reports once in a frame."""
    check_winding(path, seen.corners_px)
    frame, camera, ids, families = seen.frame, seen.camera, seen.ids, seen.families
    named = np.array(families if families is not None else [""] * len(ids), str)
    keys = np.rec.fromarrays([frame, camera, ids, named])
    _, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
    once = (count[inverse] == 1) & is_within("corner_px", seen.corners_px).all(axis=(1, 2))
    kept = np.flatnonzero(once)
    kept = kept[np.lexsort([ids[kept], camera[kept], frame[kept]])]
    return replace(
        seen,
        frame=frame[kept],
        camera=camera[kept],
        ids=ids[kept],
        corners_px=seen.corners_px[kept],
        families=None if families is None else tuple(named[kept].tolist()),
    )
