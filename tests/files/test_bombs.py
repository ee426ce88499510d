"""Small files that declare or unpack to gigabytes are refused in one line, in seconds and 2 GiB."""

import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import zarr

from jaxnav.errors import BadInput
from jaxnav.experiments.studies.store import check_sizes
from jaxnav.files import limits
from jaxnav.files.images import decode_image, read_image
from jaxnav.files.reading import read_mapping
from jaxnav.files.unpacking import read_npz
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.other import bags
from jaxnav.recordings.other.bags import decompress_bag
from jaxnav.recordings.other.recordings import read_recording
from tests.helpers import bombs

SECONDS = 10.0  # of a processor that others use too


@pytest.fixture(autouse=True)
def two_gib() -> Iterator[None]:
    """No more than 2 GiB beside what this process has already, and 10 s."""
    memory = Path("/proc/self/statm")
    if not memory.exists():
        pytest.skip("this system does not tell what memory a process has: no /proc/self/statm")
    pages = int(memory.read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2 * bombs.GIB, hard))
    began_s = time.process_time()
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.process_time() - began_s < SECONDS


def problem(load, path: Path) -> str:
    """The one line that a person gets: of a cap, not of memory that was asked for in vain."""
    with pytest.raises(BadInput) as caught:
        load(path)
    line = str(caught.value)
    assert str(path) in line
    assert "MemoryError" not in line
    assert "allocate" not in line
    return line


@pytest.mark.parametrize("name", bombs.PICTURES)
def test_a_picture_is_as_large_as_its_header_says(name, tmp_path):
    path = bombs.PICTURES[name](tmp_path / name)
    assert decode_image(path.read_bytes()) is None
    problem(read_image, path)


def test_text_with_too_many_values_is_refused(tmp_path):
    assert "more than 300000 values" in problem(
        read_mapping, bombs.yaml_brackets(tmp_path / "rig.yaml")
    )
    assert "more than 2000000 values" in problem(
        read_mapping, bombs.json_brackets(tmp_path / "layout.json")
    )


def test_a_map_of_the_largest_size_is_read(tmp_path):
    row = "  - {id: %d, family: tag36h11, size_m: 0.172, corners_world_m: %s}\n"
    corners = "[[-0.086, 1.471234, 0.312], [0.086, 1.47, 0.312], [0.086, 1.47, 0.14], [0, 1, 0]]"
    path = tmp_path / "markers.yaml"
    path.write_text("markers:\n" + "".join(row % (index, corners) for index in range(4096)))
    assert len(read_mapping(path)["markers"]) == 4096


@pytest.mark.parametrize("name", bombs.ARRAYS)
def test_arrays_are_as_large_as_their_headers_say(name, tmp_path):
    assert "npz file (" in problem(read_recording, bombs.ARRAYS[name](tmp_path / name))


def test_arrays_come_back_as_numpy_wrote_them(tmp_path):
    arrays = {
        "whole": np.arange(5),
        "columns": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        "text": np.array(["a", "bbb"]),
        "none": np.zeros((0, 4)),
        "one": np.array(3.5),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        found = read_npz(tmp_path / "a.npz")
        assert found.keys() == arrays.keys()
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)


def test_a_compressed_bag_does_not_fill_the_disk(tmp_path, monkeypatch):
    path = bombs.bz2_zeros(tmp_path / "drive.bag.bz2")
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))

    def load(path: Path) -> None:
        with decompress_bag(path):
            pass

    assert "far more than any recording" in problem(load, path)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", ["bz2", "lz4"])
def test_a_chunk_of_a_bag_is_unpacked_no_further_than_it_may_be(kind, tmp_path):
    def load(path: Path) -> None:
        bags.read_messages(path, list, lambda message: None)

    line = problem(load, bombs.bag_chunk(tmp_path / "drive.bag", kind))
    assert "a chunk that is larger" in line or "far more than any recording" in line


@pytest.mark.parametrize(
    ("definition", "expected"),
    [
        ("std_msgs/Empty[] corners\n", "a list of messages without content"),
        ("std_msgs/Empty[4000000000] corners\n", "a list of messages without content"),
        ("std_msgs/Tick[4000000000] corners\n", "a list of 4000000000 entries"),
        ("float64[4000000000] corners\n", "a list of 4000000000 entries"),
        ("string[4000000000] corners\n", "a list of 4000000000 entries"),
        ("float64[1000000] a\n" * 1, "is larger than any message"),
        ("# " + "x" * 70_000 + "\nuint8 a\n", "is too long"),
    ],
)
def test_a_definition_can_not_ask_for_more_than_a_message_holds(definition, expected):
    parts = (
        f"{definition}{'=' * 80}\nMSG: std_msgs/Empty\n{'=' * 80}\nMSG: std_msgs/Tick\nuint8 a\n"
    )
    connection = SimpleNamespace(
        msgtype="std_msgs/msg/Whole",
        msgdef=SimpleNamespace(format=bags.MessageDefinitionFormat.MSG, data=parts),
    )
    with pytest.raises(ValueError, match=expected):
        bags.typestore([connection])


@pytest.mark.parametrize("name", bombs.DRIVES)
def test_a_drive_unpacks_to_no_more_than_a_drive(name, tmp_path, monkeypatch):
    # A million messages take 30 s: that there is a cap is seen by a lower one.
    monkeypatch.setattr(limits, "MCAP_MESSAGES", 5000)
    expected = {
        "zeros.mcap": "far more than any recording",
        "ticks.mcap": "more than 5000 messages",
        "detections.mcap": "bytes",
        "covariance.mcap": "must be a square matrix",
    }
    assert expected[name] in problem(read_drive, bombs.DRIVES[name](tmp_path / name))


def test_a_store_can_not_declare_more_than_is_read_at_once(tmp_path):
    group = zarr.create_group(tmp_path / "s.zarr")
    done = {"shape": (10**6, 10**6), "chunks": (1, 1), "dtype": "int8", "fill_value": 0}
    group.create_array("done", **done)
    with pytest.raises(BadInput, match="done: is too large"):
        check_sizes(tmp_path, dict(group.arrays()))
    del group["done"]
    wide = {"shape": (10**9,), "chunks": (10**9,), "dtype": "float64", "fill_value": 0}
    group.create_array("error", **wide)
    with pytest.raises(BadInput, match="error: is too large"):
        check_sizes(tmp_path, dict(group.arrays()))


def test_ten_minutes_in_a_map_of_a_thousand_markers(tmp_path):
    path = bombs.honest_arrays(tmp_path / "d.npz", 18_000, cameras=4, markers=1000, in_view=4)
    recording = read_recording(path)
    assert (len(recording), len(recording.markers.ids)) == (18_000, 1000)
    frames = np.array([17_999, 3])
    corners_px, visible = recording.lanes(frames)
    assert visible.shape == (2, 4, 1000)
    for row, frame in enumerate(frames):
        seen = recording.seen_at[0] == frame
        assert visible[row].sum() == seen.sum() > 0
        _, cameras, markers = recording.seen_at[:, seen]
        np.testing.assert_array_equal(corners_px[row, cameras, markers], recording.seen_px[seen])


def test_a_chunk_of_a_png_that_is_larger_than_its_file_is_not_decoded():
    """A decoder takes memory for it before it reads it: 2 kB took 3.4 GB."""
    raw = bytearray(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    at = raw.index(b"IDAT") - 4
    assert decode_image(bytes(raw)) is not None
    raw[at : at + 4] = (3_345_162_068).to_bytes(4, "big")
    assert decode_image(bytes(raw)) is None
    empty = b"\0\0\0\0tEXt\0\0\0\0"
    assert decode_image(bytes(raw[:at]) + 2**17 * empty) is None
