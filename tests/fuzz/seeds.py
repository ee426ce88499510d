"""Sound files of every kind, in one folder: what the commands of the long run are given."""

import json
import shutil
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import Writer

from jaxnav import files
from jaxnav.calibration.odometry_drive import Drive
from jaxnav.detection import Detections, marker_cells
from jaxnav.runtime.drive_format import HEADER, PROFILE, encode, header_of
from jaxnav.runtime.frames import Sighted
from jaxnav.runtime.interfaces import Odometry
from jaxnav.runtime.mcap_messages import McapMessages, Recorded
from jaxnav.runtime.message_schemas import MESSAGES
from jaxnav.runtime.messages import input_message
from jaxnav.runtime.pilot import Input
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


def make(folder: Path) -> None:
    """Write all of them."""
    qcar = files.calib_dir() / "qcar"
    for name in ("rig", "vehicle", "route"):
        shutil.copy(qcar / f"{name}.yaml", folder)
    files.save_markers(folder / "markers.yaml", room_markers())
    texts = {
        "chain.yaml": KALIBR,
        "info.yaml": CAMERA_INFO,
        "opencv.yml": OPENCV,
        "photon.json": PHOTONVISION,
        "layout.json": WPILIB,
        "params.yaml": PARAMS,
        "topics.yaml": TOPICS,
        "ambiguity.yaml": AMBIGUITY,
        "drive.yaml": DRIVE,
        "board.yaml": BOARD,
        "kept.json": json.dumps(SIMULATED),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    shutil.copy(_DRIVES / "plain.mcap", folder / "drive.mcap")
    write_drive(folder / "eights.mcap", _eights())
    for loader, name in (("arrays", "decoded.npz"), ("bag", "seen.bag")):
        made = loaders.BINARY[loader].make(folder)
        made.rename(folder / name)
    ros_drive("bag").write(folder).rename(folder / "ros.bag")
    (folder / "tagslam").mkdir()
    loaders.STRUCTURED["TagSLAM tagslam.yaml"].make(folder / "tagslam")
    (folder / "study").mkdir()
    loaders.BINARY["store zarr.json"].make(folder / "study")
    photo = np.full((410, 820), 200, np.uint8)
    cells = (255 * marker_cells("tag36h11", 0)).astype(np.uint8)
    photo[150:250, 300:400] = cv2.resize(cells, (100, 100), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(folder / "photo.png"), photo)
    (folder / "images").mkdir()
    cv2.imwrite(str(folder / "images" / "1.png"), photo[:200, :300])


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
        frame = Sighted(int(drive.camera[row]), int(stamp_ns), found)
        inputs.append(Input(int(stamp_ns) + 30_000_000, frames=(frame,)))
    return sorted(inputs, key=lambda given: given.now_ns)


def drive_parts(path: Path) -> Parts:
    """A recorded drive in plain values."""
    parts: Parts = []
    for record in McapMessages(path):
        if isinstance(record, Recorded):
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
