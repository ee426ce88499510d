"""Replay a recorded drive: run its inputs again, and find where the outcomes differ.

    log = read_drive(path)
    setup = DriveSetup.from_header(log.header, path)
    difference = first_difference(log, replay_drive(log.inputs, setup, folder))

On the machine and with the versions of the recording every bit is the same, elsewhere every number
up to rounding (docs/promises.md, Replay).
"""

import dataclasses
import enum
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxnav.core.models.origin import opposite, planar_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection import Detections
from jaxnav.detection.image_search import ImageSearch, size_problem
from jaxnav.drive.flags import names
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import BadInput
from jaxnav.files.images import decode_image
from jaxnav.recordings.drive_log import DriveLog, RecordedImage
from jaxnav.recordings.drive_setup import DriveSetup, made_here
from jaxnav.recordings.records import COLUMNS, Outcomes, digest

# Rounding differences between machines, relative to values above 1.
TOLERANCE_FLOAT64, TOLERANCE_FLOAT32 = 1e-9, 1e-3

_EXACT = [name for name, column in COLUMNS.items() if column.slack == 0]
# The report first: the command follows from it.
_NEAR = [
    name
    for name in sorted(COLUMNS, key=lambda name: not COLUMNS[name].is_reported)
    if COLUMNS[name].slack
]


@dataclass(frozen=True)
class Difference:
    """The first difference between a replay and its recording.

    Attributes:
        index: index of the outcome in the recording.
        time_s: time since the first outcome.
        what: the value that differs, and by how much.
    """

    index: int
    time_s: float
    what: str


def check_inputs(inputs: Iterable[Input], setup: DriveSetup, where: Path) -> None:
    """Check that the inputs fit the rig.

    Raises:
        BadInput: a frame is from a camera that the rig does not have, or the clock runs backwards.
    """
    before_ns = 0
    for index, given in enumerate(inputs):
        if given.now_ns < before_ns:
            raise BadInput(f"{where}: now_ns[{index}]", "is less than that of the input before")
        before_ns = given.now_ns
        for frame in given.frames:
            if not 0 <= frame.camera < len(setup.rig):
                problem = f"must be from 0 to {len(setup.rig) - 1}, got {frame.camera}"
                raise BadInput(f"{where}: /frames.camera", problem)


def replay_drive(
    inputs: Sequence[Input], setup: DriveSetup, folder: Path | None
) -> Iterator[Outcome]:
    """The outcomes of a new pilot for recorded inputs, one after the other.

    Args:
        folder: folder of executables, see `compile_or_load`.
    """
    pilot = setup.pilot(folder)
    for given in inputs:
        yield pilot.handle(given)


class Comparison:
    """A comparison of a replay's outcomes with the recorded ones, one after the other.

    Bit for bit where the drive was recorded by this machine and these versions, else within the
    tolerance of its precision. Outcomes that the recording has lost are skipped.

    Attributes:
        bit_for_bit: whether bits are compared.
        compared: number of outcomes compared.
        first: the first difference; None: none yet.
    """

    def __init__(self, log: DriveLog):
        self.bit_for_bit = made_here(log.header)
        self.compared = 0
        self.first: Difference | None = None
        self._recorded, self._index = log.outcomes, 0
        float64 = bool(log.header.get("float64"))
        self._tolerance = TOLERANCE_FLOAT64 if float64 else TOLERANCE_FLOAT32

    def look(self, outcome: Outcome) -> None:
        """Compare the next outcome."""
        recorded, count = self._recorded, len(self._recorded.now_ns)
        while self._index < count and recorded.now_ns[self._index] < outcome.now_ns:
            self._index += 1
        index = self._index
        if index == count or recorded.now_ns[index] > outcome.now_ns:
            return
        self._index, self.compared = index + 1, self.compared + 1
        if self.first is not None:
            return
        what = _difference(recorded, index, outcome, self._tolerance)
        if self.bit_for_bit and recorded.digest[index] not in ("", digest(outcome)):
            what = what or _difference(recorded, index, outcome, 0.0) or "bits that are not shown"
        if what is not None:
            self.first = Difference(index, float(recorded.times_s[index]), what)


def first_difference(log: DriveLog, outcomes: Iterable[Outcome]) -> Difference | None:
    """The first difference between a replay's outcomes and the recorded ones; None: none."""
    comparison = Comparison(log)
    for outcome in outcomes:
        comparison.look(outcome)
    return comparison.first


def _difference(recorded: Outcomes, index: int, outcome: Outcome, tolerance: float) -> str | None:
    def pair(name: str) -> tuple[Any, Any]:
        return getattr(recorded, name)[index], COLUMNS[name].row(outcome)

    for name in _EXACT:
        before, now = pair(name)
        if before != now:
            before = type(now)(before) if isinstance(now, enum.Enum) else before
            return f"{name}: {_words(now)}, recorded {_words(before)}"
    for name in _NEAR:
        (before, now), bound = pair(name), (COLUMNS[name].slack or 0.0) * tolerance
        if name == "pose":  # in the coordinates of the computation, less the rounding since then
            away_m = opposite(outcome.origin_m)
            now, before = (planar_in_world(pose, away_m) for pose in (now, before))
            bound += float(np.spacing(max(map(abs, away_m)))) if tolerance else 0.0
        off = _off(np.asarray(now, float), np.asarray(before, float))
        if not off <= bound:
            return f"{name}: off by {off:.3g}"
    return None


def _off(now: np.ndarray, before: np.ndarray) -> float:
    """The largest difference, relative to values above 1; NaN equals NaN."""
    if now.shape != before.shape:
        return np.inf
    off = np.abs(now - before) / np.maximum(np.abs(before), 1.0)
    same = (now == before) | (np.isnan(now) & np.isnan(before))
    return float(np.max(np.where(same, 0.0, np.where(np.isnan(off), np.inf, off)), initial=0.0))


def _words(value: Any) -> str:
    if isinstance(value, enum.IntFlag):
        return " ".join(names(value)) or "none"
    return value.name if isinstance(value, enum.Enum) else str(value)


def recorded_pixels(
    log: DriveLog, image: RecordedImage, rig: CameraRig, camera: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The pixels of an image.

    Raises:
        BadInput: it can't be decoded, or has another size than the camera of the rig.
    """
    pixels = decode_image(image.jpeg)
    if pixels is None:
        raise BadInput(f"{log.path}: {image.topic}", "an image can't be decoded")
    if problem := size_problem(rig, camera, pixels):
        raise BadInput(f"{log.path}: {image.topic}", problem)
    return pixels


def inputs_from_images(
    log: DriveLog, setup: DriveSetup, corner_backend: str
) -> tuple[list[Input], int]:
    """The recorded inputs in their order, with new detections from the recorded images.

    A frame without a recorded image, or one that was not usable, stays as it was.

    Args:
        corner_backend: see `make_detector`.

    Returns:
        The inputs, and the number of frames that were searched anew.

    Raises:
        BadInput: there is no camera's image, or one has a wrong size; as `make_detector`.
    """
    search, detections = ImageSearch(setup.rig, setup.markers, corner_backend), {}
    camera_of = {f"/camera/{name}": index for index, name in enumerate(setup.rig.names)}
    for image in log.images():
        if image.topic not in camera_of:
            continue
        camera = camera_of[image.topic]
        pixels = recorded_pixels(log, image, setup.rig, camera)
        detections[camera, image.stamp_ns] = search.detections(camera, pixels)
    if not detections:
        raise BadInput(log.path, f"holds no image on {', '.join(camera_of)}")
    searched = 0

    def anew(frame: FrameDetections) -> FrameDetections:
        nonlocal searched
        seen: Detections | None = detections.get((frame.camera, frame.stamp_ns))
        if seen is None or frame.detections is None:
            return frame
        searched += 1
        return dataclasses.replace(frame, detections=seen)

    inputs = [
        dataclasses.replace(given, frames=tuple(map(anew, given.frames))) for given in log.inputs
    ]
    return inputs, searched
