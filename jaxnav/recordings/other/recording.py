"""Recorded detections of markers by a camera rig, as arrays.

The vehicle frame is the rig's body, the world is the marker map's frame.

Conventions of the existing recordings, as found in their data:

* Corners are counter-clockwise from the bottom left (AprilTag's order), `TO_OURS` makes them ours,
  clockwise from the top left. The marker frame is ours already: x right, y up, z to the reader.
* Pixels are used unchanged. Calibration and reference were computed from the same corners, so
  a shift by half a pixel would only make them disagree (reprojection of the reference over 31 297
  detections: 1.11 px RMS a coordinate as recorded, 1.20 and 1.22 px half a pixel to either side).
* A marker that one camera reports twice in one frame is not used in that frame and camera: one of
  the two is false, and missing a sighting costs less than believing a false one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.core.models.conventions import APRILTAG_FIRST_CORNER, TL_TR_BR_BL
from jaxnav.core.models.imu import ImuSamples, Preintegrated
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection.observe import double_area_px2
from jaxnav.detection.types import Detections
from jaxnav.drive.interfaces import Odometry
from jaxnav.errors import BadInput
from jaxnav.files.ranges import is_within
from jaxnav.recordings.ros.odometry_track import OdometryTrack

TO_OURS = TL_TR_BR_BL[APRILTAG_FIRST_CORNER]


class Reference(NamedTuple):
    """Reference poses of the vehicle by other software, one row for each frame of a recording."""

    T_world_vehicle: Float[np.ndarray, "F 7"]  # wxyz xyz, m; the identity where not valid
    valid: Bool[np.ndarray, " F"]


@dataclass(frozen=True)
class Recording:
    """A recording of N sightings of M markers by C cameras in F frames.

    Ten minutes with a map of a thousand markers are 70 million lanes, of which nearly all are
    hidden: so sightings are stored, and `lanes` makes the lanes of some frames.
    """

    name: str
    stamps_ns: Int[np.ndarray, " F"]  # increasing
    seen_at: Int[np.ndarray, "3 N"]  # frame, camera, marker of each sighting, in this order
    seen_px: Float[np.ndarray, "N 4 2"]  # TL TR BR BL
    rig: CameraRig
    markers: MarkerMap
    reference: Reference | None
    odometry: OdometryTrack | None  # of the vehicle, by other software
    imu: ImuSamples | None  # on the vehicle
    unmapped_detections: int  # of markers that are not in the map
    dropped_detections: int  # reported twice, or with a corner out of range

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def corners_px(self) -> Float[np.ndarray, "F C M 4 2"]:
        """Corners of all frames, zeros where hidden; for short recordings and small maps."""
        return self.lanes(np.arange(len(self)))[0]

    @property
    def visible(self) -> Bool[np.ndarray, "F C M"]:
        """Whether each camera saw each marker, in all frames."""
        return self.lanes(np.arange(len(self)))[1]

    @property
    def seen(self) -> Bool[np.ndarray, "F M"]:
        """Whether any camera saw each marker in each frame."""
        seen = np.zeros((len(self), len(self.markers.ids)), bool)
        seen[self.seen_at[0], self.seen_at[2]] = True
        return seen

    @property
    def twists(self) -> Float[np.ndarray, "F 6"] | None:
        """Mean twists since the frame before, see `OdometryTrack.twists`; None: no odometry."""
        return None if self.odometry is None else self.odometry.twists(self.stamps_ns)

    @property
    def preintegrated(self) -> Preintegrated | None:
        """What the IMU tells since the frame before, (F,) in every leaf; None: there is none."""
        return None if self.imu is None else self.imu.between(self.stamps_ns)

    def lanes(
        self, frames: Int[np.ndarray, " K"]
    ) -> tuple[Float[np.ndarray, "K C M 4 2"], Bool[np.ndarray, "K C M"]]:
        """Corners, zeros where hidden, and visibility of some frames in any order."""
        shape = (len(frames), len(self.rig), len(self.markers.ids))
        corners_px, visible = np.zeros((*shape, 4, 2)), np.zeros(shape, bool)
        begin = np.searchsorted(self.seen_at[0], frames)
        count = np.searchsorted(self.seen_at[0], frames, side="right") - begin
        row = np.repeat(np.arange(len(frames)), count)
        sighting = np.arange(len(row)) + np.repeat(begin - np.cumsum(count) + count, count)
        _, camera, marker = self.seen_at[:, sighting]
        corners_px[row, camera, marker] = self.seen_px[sighting]
        visible[row, camera, marker] = True
        return corners_px, visible

    def first(self, frames: int) -> "Recording":
        """The recording cut to its first frames."""
        return self._only(np.arange(min(frames, len(self))))

    def every(self, step: int) -> "Recording":
        """The recording as a camera would have taken it that is so many times slower."""
        return self._only(np.arange(0, len(self), step))

    def _only(self, frames: Int[np.ndarray, " K"]) -> "Recording":
        number = np.full(len(self), -1)
        number[frames] = np.arange(len(frames))
        kept = number[self.seen_at[0]] >= 0
        frame, *rest = self.seen_at[:, kept]
        return replace(
            self,
            stamps_ns=self.stamps_ns[frames],
            seen_at=np.stack([number[frame], *rest]),
            seen_px=self.seen_px[kept],
            reference=self.reference and Reference(*(rows[frames] for rows in self.reference)),
        )


@dataclass(frozen=True)
class Rows:
    """A table of N detections in the order of their file."""

    stamps_ns: Int[np.ndarray, " N"]
    cameras: Int[np.ndarray, " N"]  # index in the rig
    ids: Int[np.ndarray, " N"]
    corners_px: Float[np.ndarray, "N 4 2"]  # TL TR BR BL
    frame_stamps_ns: Int[np.ndarray, " F"]  # of all frames, those without a detection as well
    families: tuple[str, ...] | None = None  # (N,); None where the recording does not tell

    def reliable(self, *markers: np.ndarray) -> Int[np.ndarray, " K"]:
        """The rows to use, by stamp, camera and marker: corners that are nowhere are left out, and
        a marker that a camera reports twice in one frame.

        Args:
            markers: (N,) numbers or texts by which rows of one marker are known.
        """
        keys = self.stamps_ns, self.cameras, *markers
        order = np.lexsort(keys[::-1])
        same = np.stack([key[order[1:]] == key[order[:-1]] for key in keys]).all(axis=0)
        twice = (np.append(same, False) | np.insert(same, 0, False))[: len(order)]
        somewhere = np.asarray(is_within("corner_px", self.corners_px).all(axis=(1, 2)))
        kept: np.ndarray = order[~twice & somewhere[order]]
        return kept


def rows_of(
    frames: Sequence[tuple[int, int, Detections]],
    frame_stamps_ns: Sequence[int],
    tells_families: bool = True,
) -> Rows:
    """The table of the detections in frames.

    Args:
        frames: stamp in ns, camera, and what was detected.
        frame_stamps_ns: of all frames.
        tells_families: whether the families of the detections are known.
    """
    counts = [len(found) for *_, found in frames]
    whole = Detections.concatenate([found for *_, found in frames])
    return Rows(
        stamps_ns=np.repeat(np.array([stamp_ns for stamp_ns, *_ in frames], np.int64), counts),
        cameras=np.repeat(np.array([camera for _, camera, _ in frames], int), counts),
        ids=whole.ids.astype(np.int64),
        corners_px=whole.corners_px.astype(float),
        frame_stamps_ns=np.array(frame_stamps_ns, np.int64),
        families=whole.families if tells_families else None,
    )


@dataclass(frozen=True)
class Source:
    """The content of a recording in any format, with functions that read map and reference.

    Attributes:
        markers: returns the map; raises BadInput where there is none, or a broken one.
        reference: returns stamp in ns -> (7,) wxyz xyz of the vehicle in the world, or None.
        odometry: of the vehicle, by other software.
        imu: on the vehicle.
        readings: of a car's odometer, in the order in which they came.
    """

    name: str
    rows: Rows
    rig: CameraRig
    markers: Callable[[], MarkerMap]
    reference: Callable[[], dict[int, Float[np.ndarray, " 7"]] | None] = lambda: None
    odometry: OdometryTrack | None = None
    imu: ImuSamples | None = None
    readings: tuple[Odometry, ...] = ()


def assemble(path: Path, source: Source, markers: MarkerMap | None = None) -> Recording:
    """Make a recording of a source.

    Args:
        path: named where the corners are wrong.
        markers: replace the source's own.

    Raises:
        BadInput: two families share an id in the map, the detections do not tell families; or
            corners are in another order than they should be.
    """
    rows, rig, markers = source.rows, source.rig, markers or source.markers()
    poses = source.reference()
    check_winding(path, rows.corners_px)
    if len(set(markers.ids)) < len(markers.ids):
        raise BadInput("--markers", "ids must differ: the recording does not tell families")
    stamps = np.unique(rows.frame_stamps_ns)
    index_of_id = {marker_id: index for index, marker_id in enumerate(markers.ids)}
    index = np.array([index_of_id.get(int(marker_id), -1) for marker_id in rows.ids], int)
    mapped = index >= 0
    used = rows.reliable(index)
    used = used[mapped[used]]
    frame = np.searchsorted(stamps, rows.stamps_ns[used])
    return Recording(
        name=source.name,
        stamps_ns=stamps,
        seen_at=np.stack([frame, rows.cameras[used], index[used]]),
        seen_px=rows.corners_px[used],
        rig=rig,
        markers=markers,
        reference=None if poses is None else _align(stamps, poses),
        odometry=source.odometry,
        imu=source.imu,
        unmapped_detections=int(np.sum(~mapped)),
        dropped_detections=int(np.sum(mapped)) - len(used),
    )


def check_winding(where: str | Path, corners_px: Float[np.ndarray, "N 4 2"]) -> None:
    """Check that most detections of a file list their corners TL TR BR BL, not TR TL BL BR.

    Some may be noise: where markers are seen edge-on, or where there is none.

    Raises:
        BadInput: they do not.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what is out of range is left out later
        mirrored = int(np.sum(double_area_px2(corners_px) < 0))
    if 2 * mirrored > len(corners_px):
        problem = f"of {len(corners_px)} detections {mirrored} list their corners the other way"
        raise BadInput(where, f"{problem} round, as of markers seen from behind (see first_corner)")


def _align(stamps_ns: np.ndarray, poses: dict[int, np.ndarray]) -> Reference:
    T_world_vehicle = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(stamps_ns), 1))
    valid = np.array([int(stamp) in poses for stamp in stamps_ns], bool)
    for row in np.flatnonzero(valid):
        T_world_vehicle[row] = poses[int(stamps_ns[row])]
    return Reference(T_world_vehicle, valid)
