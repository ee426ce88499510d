"""Sound files of every kind, in one folder: what the commands of the long run are given."""

import json
import shutil
import zlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import Writer

from jaxnav import files
from jaxnav.calibrate.odometry.drive import Drive
from jaxnav.detection import Detections, marker_cells
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.recordings.drive_format import HEADER, PROFILE, encode, header_of
from jaxnav.recordings.drive_log import McapMessages, RecordedMessage
from jaxnav.recordings.records import MESSAGES, input_message
from tests.helpers import loader_seeds as loaders
from tests.helpers.odometry_drives import RECIPE, START, sensed, true_track
from tests.helpers.ros_drives import TOPICS
from tests.helpers.ros_drives import drive as ros_drive
from tests.helpers.seed_texts import (
    AMBIGUITY,
    CAMERA_INFO,
    DRIVE,
    KALIBR,
    OPENCV,
    PARAMS,
    PHOTONVISION,
    SIMULATED,
    WPILIB,
)
from tests.helpers.simulated import make_setup
from tests.worlds import paper_markers, qcar_rig, room_markers

_DRIVES = Path(__file__).resolve().parents[1] / "data" / "drives"
_EIGHTS_S = 14.0  # enough for every figure to be looked for
BOARD = """
board: charuco
columns: 7
rows: 5
square_m: 0.03
marker_m: 0.022
family: 4x4_50
"""
# Of what a recorded drive consists: its header under this name, and (topic, message) rows.
Parts = list[tuple[str, dict[str, Any]]]


def make(folder: Path, wanted: Collection[str] | None = None) -> None:
    """Write some of them.

    Args:
        wanted: their names; by default all.
    """
    for name, write in _MAKERS.items():
        if wanted is None or name in wanted:
            write(folder / name)


def _text(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text)


def _copied(source: Path) -> Callable[[Path], object]:
    return lambda path: shutil.copy(source, path)


def _loaded(name: str) -> Callable[[Path], object]:
    """What a loader reads, alone in its folder."""
    return lambda path: loaders.BINARY[name].make(path.parent).rename(path)


def _photo(path: Path) -> None:
    photo = np.full((410, 820), 200, np.uint8)
    cells = (255 * marker_cells("tag36h11", 0)).astype(np.uint8)
    photo[150:250, 300:400] = cv2.resize(cells, (100, 100), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(path), photo)


def _images(path: Path) -> None:
    path.mkdir()
    _photo(path / "1.png")


def _tagslam(path: Path) -> None:
    path.mkdir()
    loaders.STRUCTURED["TagSLAM tagslam.yaml"].make(path)


def _study(path: Path) -> None:
    path.mkdir()
    loaders.BINARY["store zarr.json"].make(path)


def _eights() -> Parts:
    rig, markers = qcar_rig(), paper_markers()
    told = sensed(true_track(RECIPE, _EIGHTS_S, start=START), rig, markers, 0)
    header = json.loads(encode(make_setup().header()))
    rows = [input_message(given)[::2] for given in inputs_of(told, markers.ids)]
    return [("header", header), *((topic, json.loads(encode(row))) for topic, row in rows)]


def inputs_of(drive: Drive, ids: tuple[int, ...]) -> list[Input]:
    """As they reach a pilot: readings at once, frames some 30 ms late."""
    readings = zip(drive.reading_stamps_ns, drive.speed_mps, drive.steering_rad, strict=True)
    inputs = [Input(int(t), Odometry(int(t), float(v), float(d))) for t, v, d in readings]
    for row, stamp_ns in enumerate(drive.view_stamps_ns):
        found = Detections(
            ids=np.array([ids[drive.marker[row]]]),
            corners_px=drive.corners_px[row][None],
            sigma_px=drive.sigma_px[row][None],
            refined=np.array([True]),
            families=("tag36h11",),
        )
        frame = FrameDetections(int(drive.camera[row]), int(stamp_ns), found)
        inputs.append(Input(int(stamp_ns) + 30_000_000, frames=(frame,)))
    return sorted(inputs, key=lambda given: given.now_ns)


def drive_parts(path: Path) -> Parts:
    """A recorded drive in plain values."""
    parts: Parts = []
    for record in McapMessages(path):
        if isinstance(record, RecordedMessage):
            if record.topic in MESSAGES:
                parts.append((record.topic, json.loads(record.data)))
        elif record.name == HEADER:
            header_of(record.metadata, path)
            parts.insert(0, ("header", json.loads(record.metadata["header"])))
    return parts


def write_drive(path: Path, parts: Parts) -> None:
    """A recorded drive with sound checksums, as another program could write it."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile=PROFILE, library="fuzz")
        channels: dict[str, int] = {}
        counts: dict[str, int] = {}
        for topic, message in parts:
            text = json.dumps(message)
            if topic == "header":
                crc32 = f"{zlib.crc32(text.encode()):08x}"
                writer.add_metadata(HEADER, {"format_version": "1", "header": text, "crc32": crc32})
                continue
            if topic not in channels:
                schema = writer.register_schema(MESSAGES[topic][0], "jsonschema", b"{}")
                channels[topic] = writer.register_channel(topic, "json", schema)
            counts[topic] = counts.get(topic, -1) + 1
            writer.add_message(channels[topic], 1, text.encode(), 1, counts[topic])
        writer.finish()


_QCAR = files.calib_dir() / "qcar"
_MAKERS: dict[str, Callable[[Path], object]] = {
    **{name: _copied(_QCAR / name) for name in ("rig.yaml", "vehicle.yaml", "route.yaml")},
    "markers.yaml": lambda path: files.save_markers(path, room_markers()),
    "chain.yaml": _text(KALIBR),
    "info.yaml": _text(CAMERA_INFO),
    "opencv.yml": _text(OPENCV),
    "photon.json": _text(PHOTONVISION),
    "layout.json": _text(WPILIB),
    "params.yaml": _text(PARAMS),
    "topics.yaml": _text(TOPICS),
    "ambiguity.yaml": _text(AMBIGUITY),
    "drive.yaml": _text(DRIVE),
    "board.yaml": _text(BOARD),
    "kept.json": _text(json.dumps(SIMULATED)),
    "drive.mcap": _copied(_DRIVES / "plain.mcap"),
    "eights.mcap": lambda path: write_drive(path, _eights()),
    "decoded.npz": _loaded("arrays"),
    "seen.bag": _loaded("bag"),
    "ros.bag": lambda path: ros_drive("bag").write(path.parent).rename(path),
    "tagslam": _tagslam,
    "study": _study,
    "photo.png": _photo,
    "images": _images,
}
