"""Read the cameras, one thread each, and search their frames for markers in further threads.

A camera's thread hands over its latest frame; older ones are dropped, and so are searched frames
that the loop has not taken when the camera's next one is searched: a loop that is too slow handles
fewer frames, not later ones. The searching threads take frames camera by camera. They search first
where the filter expects the markers, and the whole image now and then, and whenever nothing was
found where it should be.
"""

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from jaxnav.core.models.camera import Camera as CameraModel
from jaxnav.detection.families import marker_cells, printed
from jaxnav.detection.signs_of_life import watched_by
from jaxnav.detection.track import warm_up_fits
from jaxnav.detection.tracker import Tracker
from jaxnav.detection.types import Detections, Detector, RegionDetector
from jaxnav.drive.expect import Region
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FROZEN_AFTER, FrameDetections
from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import Camera, Frame
from jaxnav.files.ranges import RANGES

_READ_S = 0.05  # longest wait of a camera's thread
_RETRY_S = 0.05
_MIN_SPREAD = 2.0  # grey levels: an image with less spread shows nothing at all
_SAMPLE = 16  # step between the rows and columns whose spread is taken

WHOLE_EVERY = 10  # frames of a camera

_NONE = Detections.concatenate([])


@dataclass(frozen=True)
class SearchedFrame:
    """A frame and the detections in it."""

    sighted: FrameDetections
    frame: Frame
    camera_name: str


class Search:
    """The search for markers in one camera's frames. For one thread at a time."""

    def __init__(
        self,
        camera: int,
        size_px: tuple[int, int],
        model: CameraModel,
        detectors: Sequence[Detector],
        tracker: Tracker | None = None,
    ):
        """Args:
        camera: its index in the rig.
        size_px: width and height of its images.
        tracker: follows the expected markers that the detectors do not read; None: nothing does.
        """
        self._camera, self._size_px, self._model = camera, size_px, model
        self._detectors, self.tracker = list(detectors), tracker
        self._warm = False
        self._since_whole = camera  # so that cameras take turns
        self._picture, self._pictures = b"", 0  # the last picture, and how often it repeated

    def warm_up(self) -> None:
        """Compile or load all that a frame may need, and search pictures of markers of the map.

        So no frame takes longer than others, and none hangs: compilers give no sign of life. Once
        is enough.
        """
        if self._warm:
            return
        for detector in self._detectors:
            marker_id = min(detector.ids or (0,))
            warm_up_fits(self._model, detector.family, marker_id, self.tracker is not None)
            # By another one: what is seen now is nobody's past.
            twin = Search(self._camera, self._size_px, self._model, [detector])
            image, quad_px = self._picture_of(detector.family, marker_id)
            twin.look(Frame(0, image), None)
            twin.look(Frame(1, image), Region(quad_px[None], np.array([4.0])))
        self._warm = True

    def _picture_of(self, family: str, marker_id: int) -> tuple[np.ndarray, np.ndarray]:
        """A picture with a marker in its middle, or that part of it that it has room for, and the
        marker's corners."""
        width, height = self._size_px
        image = np.full((height, width), 160, np.uint8)
        cells = len(marker_cells(family, marker_id))
        marker, quad_px = printed(family, marker_id, max(min(width, height, 128) // (cells + 2), 1))
        marker = marker[:height, :width]
        row, column = (height - len(marker)) // 2, (width - marker.shape[1]) // 2
        image[row : row + len(marker), column : column + marker.shape[1]] = marker
        return image, quad_px + np.array([column, row])

    def look(self, frame: Frame, region: Region | None) -> FrameDetections:
        """Search a frame for markers.

        Args:
            region: where markers should be, possibly nowhere; None where that is not known.
        """
        if frame.detections is not None:
            return FrameDetections(self._camera, frame.stamp_ns, frame.detections)
        fault = image_fault(frame.image, self._size_px)
        if fault or frame.image is None:
            return FrameDetections(self._camera, frame.stamp_ns, None, fault)
        if self._repeats(frame.image):
            return FrameDetections(self._camera, frame.stamp_ns, None, Fault.FRAME_FROZEN)
        self._since_whole += 1
        detections = _NONE
        near = region is not None and region.decided and self._since_whole < WHOLE_EVERY
        if region is not None and near:
            if not len(region.quads_px):
                return FrameDetections(self._camera, frame.stamp_ns, _NONE)
            parts = [
                detector.detect_near(frame.image, self._model, region.quads_px, region.radius_px)
                for detector in self._detectors
                if isinstance(detector, RegionDetector)
            ]
            detections = self._followed(frame, region, Detections.concatenate(parts))
        if not len(detections):
            self._since_whole = 0
            quads_px = None if region is None else region.quads_px
            detections = Detections.concatenate(
                [one.detect(frame.image, self._model, quads_px) for one in self._detectors]
            )
            if region is not None and not near:  # else none of them could be followed just now
                detections = self._followed(frame, region, detections)
        return FrameDetections(self._camera, frame.stamp_ns, detections)

    def _repeats(self, image: np.ndarray) -> bool:
        """Whether a picture has come FROZEN_AFTER times in a row: every sensor has noise. Bytes are
        compared, which takes 20 us and sees more than any digest of the same time."""
        picture = image.tobytes()
        self._pictures = self._pictures + 1 if picture == self._picture else 1
        self._picture = picture
        return self._pictures >= FROZEN_AFTER

    def _followed(self, frame: Frame, region: Region, detections: Detections) -> Detections:
        """The detections, and the expected markers that were followed without being decoded."""
        if self.tracker is None or not region.keys or frame.image is None:
            return detections
        row_time_s = _told("row_time_s", frame.row_time_s)
        self.tracker.set_timing(_told("exposure_s", frame.exposure_s), row_time_s)
        ahead_ns = 0 if region.stamp_ns is None else frame.stamp_ns - region.stamp_ns
        followed = self.tracker.follow(
            frame.image,
            self._model,
            region.keys,
            region.quads_px,
            region.radius_px,
            region.flow_px_s,
            ahead_ns / 1e9,
            detections,
        )
        return Detections.concatenate([detections, followed])


def _told(name: str, value: float | None) -> float | None:
    """A time that a driver tells; None where no camera can have it. A short exposure may be 0."""
    return value if value is not None and 0 <= value <= RANGES[name].most else None


def image_fault(image: np.ndarray | None, size_px: tuple[int, int]) -> Fault:
    """The fault of an image that can't be searched; `Fault(0)` if it can."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        return Fault.FRAME_UNUSABLE
    if image.shape[1::-1] != tuple(size_px) or image.shape[2:] not in ((), (3,)):
        return Fault.FRAME_UNUSABLE
    flat = float(np.std(image[::_SAMPLE, ::_SAMPLE])) < _MIN_SPREAD
    return Fault.FRAME_UNUSABLE if flat else Fault(0)


class Eyes:
    """The cameras of a rig, with the threads that read and search them."""

    def __init__(
        self, cameras: Sequence[Camera], searches: Sequence[Search], guard: Guard, workers: int = 2
    ):
        """Args:
        searches: one for each camera.
        guard: gets the threads' signs of life, and trips on their errors.
        workers: number of threads that search for markers.
        """
        self._cameras, self._searches, self._guard = list(cameras), list(searches), guard
        self._woken = threading.Condition()
        self._frames: list[Frame | None] = [None] * len(cameras)
        self._busy = [False] * len(cameras)
        self._turn = 0
        self._waiting = threading.Condition()
        self._seen: dict[int, SearchedFrame] = {}  # by camera
        self._over = threading.Event()
        self.dropped = 0  # frames replaced by newer ones, before a search or after it
        self.errors = [0] * len(cameras)  # failed reads
        self.expected: Callable[[int], Region | None] = lambda camera: None
        turns: list[tuple[str, Callable[[], None]]] = [
            (f"camera {camera.name}", partial(self._read, c)) for c, camera in enumerate(cameras)
        ]
        turns += [(f"detector {number}", self._look) for number in range(workers)]
        self._threads = [
            threading.Thread(target=self._repeat, args=turn, name=turn[0], daemon=True)
            for turn in turns
        ]

    def start(self) -> None:
        """Start the threads."""
        for search in self._searches:
            search.warm_up()
        for thread in self._threads:
            thread.start()

    def take(self) -> list[SearchedFrame]:
        """The last searched frame of each camera since the last call, in the order of stamps."""
        with self._woken:
            seen, self._seen = self._seen, {}
        return sorted(seen.values(), key=lambda one: one.sighted.stamp_ns)

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame was searched, or the time is over."""
        with self._woken:
            if not self._seen and timeout_s > 0:
                self._woken.wait(timeout_s)

    def close(self) -> None:
        """End the threads, except any that hang, and close the cameras."""
        self._over.set()
        with self._waiting:
            self._waiting.notify_all()
        for camera in self._cameras:
            with suppress(OSError):
                camera.close()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(0.5)

    def _repeat(self, name: str, turn: Callable[[], None]) -> None:
        """Take turns until the end, watched by the guard. Runs in a thread."""
        beat = partial(self._guard.beat, name)
        try:
            with watched_by(beat):
                while not self._over.is_set():
                    beat()
                    turn()
        except Exception as error:  # its meaning is unknown: the vehicle stops
            self._guard.trip(f"{name}: {type(error).__name__}: {error}")
        finally:
            self._guard.leave(name)

    def _read(self, index: int) -> None:
        try:
            frame = self._cameras[index].read(_READ_S)
        except OSError:
            self.errors[index] += 1
            self._over.wait(_RETRY_S)
            return
        if frame is not None:
            with self._waiting:
                self.dropped += self._frames[index] is not None
                self._frames[index] = frame
                self._waiting.notify()

    def _look(self) -> None:
        if (task := self._next()) is None:
            return
        index, frame = task
        try:
            # A camera that detects markers itself needs no region.
            region = self.expected(index) if frame.detections is None else None
            sighted = self._searches[index].look(frame, region)
            with self._woken:
                self.dropped += index in self._seen
                self._seen[index] = SearchedFrame(sighted, frame, self._cameras[index].name)
                self._woken.notify()
        finally:
            self._busy[index] = False

    def _next(self) -> tuple[int, Frame] | None:
        """The camera whose turn it is, and its frame; None: none came in time."""
        with self._waiting:
            for attempt in (0, 1):
                for offset in range(len(self._frames)):
                    index = (self._turn + offset) % len(self._frames)
                    frame = self._frames[index]
                    if frame is not None and not self._busy[index]:
                        self._frames[index], self._busy[index] = None, True
                        self._turn = index + 1
                        return index, frame
                if attempt == 0:
                    self._waiting.wait(_READ_S)
        return None


def group_frames(
    seen: Sequence[SearchedFrame],
) -> tuple[list[tuple[FrameDetections, ...]], tuple[FrameDetections, ...]]:
    """Group sightings for the pilot: those with markers, one group per instant, and those without,
    which need no call of their own."""
    by_stamp: dict[int, list[FrameDetections]] = {}
    empty: list[FrameDetections] = []
    for one in seen:
        sighted = one.sighted
        shows = sighted.detections is not None and len(sighted.detections) > 0
        (by_stamp.setdefault(sighted.stamp_ns, []) if shows else empty).append(sighted)
    return [tuple(by_stamp[stamp_ns]) for stamp_ns in sorted(by_stamp)], tuple(empty)
