"""Files of some kilobytes that declare, or unpack to, gigabytes or hours of work.

Each function writes one in far less than a second and returns its path.
"""

import bz2
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, Message, Schema
from mcap.writer import Writer

from jaxnav.recordings.drive_format import header_metadata
from jaxnav.recordings.records import MESSAGES
from tests.helpers.drives import OUTCOME, REPORTED

GIB = 2**30
HUGE_PX = 30_000  # OpenCV itself refuses more than 2**30 pixels


# --- pictures ---


def gif(path: Path) -> Path:
    """35 bytes of which OpenCV makes 6.7 GiB."""
    screen = struct.pack("<HHBBB", HUGE_PX, HUGE_PX, 0x80, 0, 0) + bytes(6)
    frame = b"\x2c" + struct.pack("<HHHHB", 0, 0, HUGE_PX, HUGE_PX, 0)
    path.write_bytes(b"GIF89a" + screen + frame + b"\x02\x02\x4c\x01\0;")
    return path


def png(path: Path, side_px: int = HUGE_PX) -> Path:
    """Black, with all of its rows: a thousandth of what they are."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = zlib.crc32(kind + data)
        return struct.pack(">L", len(data)) + kind + data + struct.pack(">L", checksum)

    packer = zlib.compressobj(1)
    row = bytes(1 + 3 * side_px)
    rows = b"".join(packer.compress(row) for _ in range(200)) + packer.flush()
    header = struct.pack(">LLBBBBB", side_px, side_px, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
    return path


def jpeg_scans(path: Path) -> Path:
    """As many passes over the picture as anybody likes."""
    path.write_bytes(b"\xff\xd8\xff\xc2\0\x0b\x08\x10\0\x10\0\x01\x01\x11\0" + b"\xff\xda" * 5000)
    return path


def tiff_tile(path: Path) -> Path:
    """A small picture in one enormous tile."""
    tags = [
        (256, 16),
        (257, 16),
        (258, 8),
        (259, 1),
        (262, 1),
        (277, 1),
        (322, 2**30),
        (323, 2**30),
    ]
    entries = b"".join(struct.pack("<HHLL", tag, 4, 1, value) for tag, value in tags)
    path.write_bytes(b"II*\0" + struct.pack("<LH", 8, len(tags)) + entries + bytes(100))
    return path


def tiff_tags(path: Path) -> Path:
    """Its width is there twice: the first one counts for libtiff, the last one for Pillow."""
    tags = [(256, 2**16), (256, 16), (257, 2**15), (258, 8), (259, 1), (262, 1), (277, 1), (273, 8)]
    entries = b"".join(struct.pack("<HHLL", tag, 4, 1, value) for tag, value in tags)
    path.write_bytes(b"II*\0" + struct.pack("<LH", 8, len(tags)) + entries + bytes(400))
    return path


def pnm_comment(path: Path) -> Path:
    """A comment within a number: 30 000 x 1 for Pillow, 30 000 x 30 000 for OpenCV."""
    path.write_bytes(b"P5 30000#30000\n 1 255\n" + bytes(30_000))
    return path


# --- text ---


def yaml_brackets(path: Path) -> Path:
    """2 MB of empty lists."""
    path.write_text("cameras: [" + "[]," * 600_000 + "]\n")
    return path


def json_brackets(path: Path) -> Path:
    """7 MB of empty lists."""
    path.write_text('{"tags": [' + "[]," * 2_200_000 + "[]]}")
    return path


# --- arrays ---


def _npz(path: Path, name: str, header: bytes, zeros: int) -> Path:
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(f"{name}.npy", "w", force_zip64=True) as member,
    ):
        member.write(header)
        for _ in range(zeros // 2**20):
            member.write(bytes(2**20))
    return path


def npz_shape(path: Path) -> Path:
    """A header that declares 8 TB, and nothing behind it."""
    text = b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000,), }\n"
    return _npz(path, "stamp_ns", b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text, 0)


def npz_zeros(path: Path) -> Path:
    """300 MiB of zeros in 300 kB."""
    count = 300 * 2**17
    text = f"{{'descr': '<i8', 'fortran_order': False, 'shape': ({count},), }}\n".encode()
    header = b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text
    return _npz(path, "stamp_ns", header, 300 * 2**20)


def npz_header(path: Path) -> Path:
    """A header of 4 GiB, of version 2."""
    return _npz(path, "stamp_ns", b"\x93NUMPY\2\0" + struct.pack("<L", 2**32 - 1), 2**26)


def npz_directory(path: Path) -> Path:
    """Twenty-five thousand members."""
    with zipfile.ZipFile(path, "w") as archive:
        for index in range(25_000):
            archive.writestr(f"{index}", b"")
    return path


# --- recordings ---


def bz2_zeros(path: Path) -> Path:
    """5 GiB in 15 kB: streams one after the other."""
    path.write_bytes(bz2.compress(bytes(2**24)) * 320)
    return path


def bag_chunk(path: Path, kind: str = "bz2") -> Path:
    """A ROS 1 bag of one chunk that unpacks to 1 GiB."""

    def record(fields: dict[str, bytes], data: bytes) -> bytes:
        header = b"".join(
            struct.pack("<L", len(key) + 1 + len(value)) + key.encode() + b"=" + value
            for key, value in fields.items()
        )
        return struct.pack("<L", len(header)) + header + struct.pack("<L", len(data)) + data

    piece = bytes(2**24)
    packed = (bz2.compress if kind == "bz2" else lz4.frame.compress)(piece) * 64
    chunk = record(
        {"op": b"\5", "compression": kind.encode(), "size": struct.pack("<L", GIB)}, packed
    )
    index_data = struct.pack("<LLL", 1, 0, 0)
    index = record(
        {"op": b"\4", "ver": struct.pack("<L", 1), "conn": bytes(4), "count": b"\1\0\0\0"},
        index_data,
    )
    about = record({"type": b"apriltag_msgs/ApriltagArrayStamped", "md5sum": b"*",
                    "message_definition": b"uint32 id"}, b"")[:-4]  # fmt: skip
    connection_header = record({"op": b"\7", "conn": bytes(4), "topic": b"/front"}, b"")[:-4]
    connection = connection_header + about
    first = len(b"#ROSBAG V2.0\n") + 4096
    info = record(
        {"op": b"\6", "ver": struct.pack("<L", 1), "chunk_pos": struct.pack("<Q", first),
         "start_time": bytes(8), "end_time": bytes(8), "count": b"\1\0\0\0"},
        struct.pack("<LL", 0, 1),
    )  # fmt: skip
    end = struct.pack("<Q", first + len(chunk) + len(index))
    fields = {"op": b"\3", "index_pos": end, "conn_count": b"\1\0\0\0", "chunk_count": b"\1\0\0\0"}
    head = record(fields, b"")
    head = head[:-4] + struct.pack("<L", 4096 - len(head)) + bytes(4096 - len(head))
    path.write_bytes(b"#ROSBAG V2.0\n" + head + chunk + index + connection + info)
    return path


def in_chunks(path: Path, chunk: Chunk, times: int = 1) -> Path:
    """A recorded drive: one chunk again and again."""
    outer = RecordBuilder()
    chunk.write(outer)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("jaxnav.drive", header_metadata({}))
        file.write(outer.end() * times)
        writer.finish()
    return path


def _packed(data: bytes) -> Chunk:
    return Chunk("zstd", zstandard.compress(data), 0, 0, 0, len(data))


def _mcap(path: Path, topic: str, messages: list[dict[str, Any]], times: int = 1) -> Path:
    """A recorded drive: a chunk with these messages, so many times."""
    inner = RecordBuilder()
    Schema(1, b"{}", "jsonschema", MESSAGES[topic][0]).write(inner)
    Channel(1, topic, "json", {}, 1).write(inner)
    for sequence, message in enumerate(messages):
        Message(1, 0, json.dumps(message).encode(), 0, sequence).write(inner)
    return in_chunks(path, _packed(inner.end()), times)


def mcap_zeros(path: Path) -> Path:
    """Thirty chunks of 60 MiB in 60 kB, of records that are none."""
    data = (b"\x7f" + struct.pack("<Q", 2**22 - 9) + bytes(2**22 - 9)) * 15
    return in_chunks(path, _packed(data), 30)


def mcap_ticks(path: Path) -> Path:
    """Three million inputs without data."""
    return _mcap(path, "/tick", [{"now_ns": 1, "faults": []}] * 3000, times=1000)


def mcap_detections(path: Path) -> Path:
    """Frames of two hundred thousand detections."""
    count = 200_000
    sighted = {
        "camera": 0, "stamp_ns": 1, "usable": True, "ids": [1] * count, "families": ["a"] * count,
        "corners_px": [1.0] * 8 * count, "sigma_px": [1.0] * 4 * count, "refined": [True] * count,
        "faults": [],
    }  # fmt: skip
    return _mcap(path, "/frames", [{"now_ns": 1, "faults": [], "frames": [sighted]}], times=40)


def mcap_covariance(path: Path) -> Path:
    """One covariance of 500 x 500, and a table that would have a row of it for each outcome."""
    whole = OUTCOME | REPORTED | {"covariance": [1.0] * 250_000}
    return _mcap(path, "/outcome", [whole, *[OUTCOME] * 3000])


PICTURES: dict[str, Callable[[Path], Path]] = {
    "a.gif": gif,
    "a.png": png,
    "a.jpg": jpeg_scans,
    "a.tif": tiff_tile,
    "twice.tif": tiff_tags,
    "a.pgm": pnm_comment,
}
ARRAYS: dict[str, Callable[[Path], Path]] = {
    "shape.npz": npz_shape,
    "zeros.npz": npz_zeros,
    "header.npz": npz_header,
    "directory.npz": npz_directory,
}
DRIVES: dict[str, Callable[[Path], Path]] = {
    "zeros.mcap": mcap_zeros,
    "ticks.mcap": mcap_ticks,
    "detections.mcap": mcap_detections,
    "covariance.mcap": mcap_covariance,
}


def honest_arrays(path: Path, frames: int, cameras: int, markers: int, in_view: int) -> Path:
    """A recording as an .npz: some markers of a large map in every frame."""
    rng = np.random.default_rng(0)
    count = frames * in_view
    eye = np.eye(4)
    Ts_map_tag = np.tile(eye, (markers, 1, 1))
    Ts_map_tag[:, :2, 3] = rng.uniform(-50, 50, (markers, 2))
    Ts_map_tag[:, 2, 3] = 3.0
    centers = rng.uniform(50, 590, (count, 1, 2))
    square = np.array([[-20.0, 20], [20, 20], [20, -20], [-20, -20]])
    np.savez(
        path,
        stamp_ns=np.repeat(np.arange(frames) * 33_333_333 + 1, in_view),
        cam=rng.integers(0, cameras, count),
        tag_id=rng.integers(0, markers, count),
        corners_px=centers + square,
        cam_names=np.array([f"cam{index}" for index in range(cameras)]),
        K=np.array([[400.0, 400, 320, 320]] * cameras),
        dist=np.zeros((cameras, 5)),
        dist_model=np.array(["equidistant"] * cameras),
        T_rig_cam=np.tile(eye, (cameras, 1, 1)),
        map_ids=np.arange(markers) % 587 if markers <= 587 else np.arange(markers),
        map_size=np.full(markers, 0.2),
        T_map_tag=Ts_map_tag,
    )
    return path
