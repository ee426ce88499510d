"""A recorded drive is read back whole, up to a cut, or not at all, but never wrongly."""

import dataclasses
import functools
import io
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from jaxnav.errors import BadInput
from jaxnav.recordings.drive_format import encode, header_metadata
from jaxnav.recordings.drive_log import DriveLog, read_drive
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import MESSAGES, json_schema
from tests.helpers.bombs import in_chunks as in_chunks_of
from tests.helpers.drives import (
    BEGIN_NS,
    OUTCOME,
    PERIOD_NS,
    REPORTED,
    make_input,
    make_outcome,
    record_drive,
    same_input,
)

COUNT = 24
HEADER = {"rig": "cameras: ...", "route_m": [[1.3, 0.0], [0.5, 0.65]]}


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("drives") / "drive.mcap"
    recorder = Recorder(path, HEADER)
    record_drive(recorder, COUNT)
    recorder.close()
    assert recorder.failed is None
    return path


@pytest.fixture(scope="module")
def whole(path) -> DriveLog:
    return read_drive(path)


def test_inputs_come_back_in_their_order(whole):
    assert len(whole.inputs) == COUNT
    for index, back in enumerate(whole.inputs):
        assert same_input(back, make_input(index))
        assert back.faults == make_input(index).faults
    assert whole.header == HEADER
    assert (whole.truncated, whole.missing) == (False, {})


def test_who_waits_is_told_how_far_it_is(path):
    told = []
    read_drive(path, told.append)
    assert sum(told) == path.stat().st_size


def test_outcomes_are_tables(whole):
    outcomes = whole.outcomes
    expected = [make_outcome(index) for index in range(COUNT)]
    np.testing.assert_array_equal(outcomes.now_ns, BEGIN_NS + PERIOD_NS * np.arange(COUNT))
    np.testing.assert_allclose(outcomes.times_s, 0.01 * np.arange(COUNT))
    np.testing.assert_array_equal(outcomes.throttle, [one.throttle for one in expected])
    assert outcomes.covariance.shape == (COUNT, 6, 6)
    np.testing.assert_array_equal(outcomes.covariance[5], expected[5].output.covariance)
    np.testing.assert_array_equal(outcomes.costs[2], [0.5, np.inf])
    assert outcomes.digest[3] == "digest 3"


def test_what_an_outcome_does_not_report_is_missing(tmp_path):
    messages = [OUTCOME, OUTCOME | REPORTED | {"selected": 0, "located": True}]
    outcomes = read_drive(_file(tmp_path, *(("/outcome", one) for one in messages))).outcomes
    assert np.isnan(outcomes.pose[0]).all()
    assert np.isnan(outcomes.covariance[0]).all()
    np.testing.assert_array_equal(outcomes.covariance[1], np.zeros((3, 3)))
    np.testing.assert_array_equal(outcomes.nis, [np.nan, 0])
    np.testing.assert_array_equal(outcomes.selected, [-1, 0])
    np.testing.assert_array_equal(outcomes.located, [False, True])
    assert [part.shape for part in outcomes.hypotheses] == [(0, 3), (0, 3)]
    assert [part.shape for part in outcomes.Ts_vehicle_world] == [(0, 7), (0, 7)]


def test_images_are_read_when_they_are_asked_for(whole):
    images = list(whole.images())
    assert [image.stamp_ns for image in images] == [make_input(i).now_ns for i in (0, 10, 20)]
    assert all(image.jpeg.startswith(b"\xff\xd8") for image in images)
    assert {image.topic for image in images} == {"/camera/front"}


def test_a_drive_without_anything(tmp_path):
    Recorder(tmp_path / "drive.mcap", {}).close()
    log = read_drive(tmp_path / "drive.mcap")
    assert (log.inputs, log.truncated, list(log.images())) == ((), False, [])
    assert log.outcomes.pose.shape == (0, 3)
    assert log.outcomes.times_s.shape == (0,)


@pytest.fixture(scope="module")
def in_chunks(tmp_path_factory) -> bytes:
    """The same drive in many small chunks, so that a cut leaves some."""
    raw = io.BytesIO()
    writer = Writer(raw, chunk_size=2000, enable_data_crcs=True)
    writer.start()
    writer.add_metadata("jaxnav.drive", header_metadata(HEADER))
    record_drive(_Direct(writer), COUNT)
    writer.finish()
    return raw.getvalue()


class _Direct:
    """A recorder without a thread, without images, and without a queue."""

    def __init__(self, writer: Writer):
        self.writer, self.channels, self.sequences = writer, {}, {}

    def put(self, topic, stamp_ns, message, raw: bytes | None = None, schema: str | None = None):
        if topic not in self.channels:
            name, model = MESSAGES[topic]
            number = self.writer.register_schema(schema or name, "jsonschema", json_schema(model))
            self.channels[topic] = self.writer.register_channel(topic, "json", number)
        sequence = self.sequences[topic] = self.sequences.get(topic, -1) + 1
        raw = encode(message) if raw is None else raw
        self.writer.add_message(self.channels[topic], stamp_ns, raw, stamp_ns, sequence)

    def image(self, topic, stamp_ns, pixels):
        """Left out."""


def _same_beginning(log: DriveLog, of: DriveLog) -> bool:
    inputs = zip(log.inputs, of.inputs, strict=False)
    count = len(log.outcomes.now_ns)
    return (
        log.header == of.header
        and len(log.inputs) <= len(of.inputs)
        and all(same_input(one, other) for one, other in inputs)
        and all(
            np.array_equal(
                getattr(log.outcomes, name), getattr(of.outcomes, name)[:count], equal_nan=True
            )
            for name in ("now_ns", "health", "faults", "steering_rad", "pose", "nis", "selected")
        )
        and log.outcomes.digest == of.outcomes.digest[:count]
    )


def test_a_file_cut_off_anywhere_is_read_up_to_the_cut(in_chunks, whole, tmp_path):
    path = tmp_path / "cut.mcap"
    counts = []
    cuts = np.random.default_rng(0).choice(len(in_chunks), 120, replace=False)
    for cut in np.append(np.sort(cuts), len(in_chunks)):
        path.write_bytes(in_chunks[:cut])
        try:
            log = read_drive(path)
        except BadInput:
            assert counts == []  # it has no header yet
            continue
        assert _same_beginning(log, whole)
        assert log.truncated == (cut < len(in_chunks))
        assert log.missing == {}
        counts.append(len(log.inputs))
    assert counts == sorted(counts)
    assert len(set(counts)) > 8
    assert counts[-1] == COUNT


def test_any_changed_byte_means_the_same_or_is_noticed(in_chunks, whole, tmp_path):
    """What is left may be less (a length that points beyond the end looks like a cut, a chunk may
    be of an unknown kind), and says so."""
    path, rng = tmp_path / "changed.mcap", np.random.default_rng(1)
    noticed = 0
    places = np.concatenate([np.arange(400), rng.integers(400, len(in_chunks), 300)])
    for place in places:
        changed = bytearray(in_chunks)
        changed[place] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            log = read_drive(path)
        except BadInput:
            noticed += 1
            continue
        assert _same_beginning(log, whole)
        assert len(log.inputs) == COUNT or log.truncated
    assert noticed > 300


def _file(tmp_path: Path, *messages, header: dict | None = None, **options) -> Path:
    """A sound MCAP file of (topic, message, raw bytes instead, schema's name instead)."""
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        writer.add_metadata("jaxnav.drive", header_metadata({}) if header is None else header)
        direct = _Direct(writer)
        for topic, message, *rest in messages:
            direct.put(topic, 1, message, *rest)
        writer.finish()
    return path


TICK = {"now_ns": 1, "faults": []}


def test_wrong_messages_are_named(tmp_path):
    sized = [("/outcome", OUTCOME | REPORTED | {"covariance": [0.0] * n}) for n in (9, 4)]
    for messages, problem in [
        ([("/tick", TICK, None, "jaxnav.Tock")], "/tick: expected jaxnav.Tick in json, got"),
        ([("/tick", TICK), ("/tick", {"now_ns": 1})], r"/tick\[1\].faults: missing"),
        ([("/tick", TICK, b"{")], r"/tick\[0\]: is not valid JSON"),
        ([("/tick", TICK | {"x": 1})], r"/tick\[0\].x: unknown key"),
        ([("/odometry", TICK)], r"/odometry\[0\].stamp_ns: missing"),
        ([("/frames", TICK | {"frames": []})], r"/frames\[0\].frames: must have at least 1"),
        ([("/outcome", OUTCOME | {"health": "FINE"})], r"/outcome\[0\].health: unknown word"),
        (sized, r"/outcome.covariance: differ in size: \[2, 3\]"),
    ]:
        path = _file(tmp_path, *messages)
        with pytest.raises(BadInput, match=f"^{path}: {problem}"):
            read_drive(path)


def test_files_that_are_no_drive_are_named(in_chunks, tmp_path):
    foreign = io.BytesIO()
    writer = Writer(foreign)
    writer.start()
    writer.finish()
    lz4 = _file(tmp_path, ("/tick", TICK), compression=CompressionType.LZ4).read_bytes()
    no_mcap = b"", b"\x89MCAP", b"PK\x03\x04 some other file", bytes(1000)
    path = tmp_path / "drive.mcap"
    for content, problem in [
        *((raw, "is not an MCAP file") for raw in no_mcap),
        (foreign.getvalue(), "is no recorded drive"),
        (lz4, "is damaged .*compressed by 'lz4', only zstd is read"),
        (in_chunks[:60], "is cut off before its header"),
    ]:
        path.write_bytes(content)
        with pytest.raises(BadInput, match=rf"drive.mcap: {problem}"):
            read_drive(path)


def test_other_ways_to_write_mcap_are_read(tmp_path):
    messages = [("/tick", TICK | {"now_ns": index}) for index in range(5)]
    for options in ({"use_chunking": False}, {"compression": CompressionType.NONE}):
        log = read_drive(_file(tmp_path, *messages, **options))
        assert [given.now_ns for given in log.inputs] == [0, 1, 2, 3, 4]


def test_what_grows_without_bounds_is_refused(tmp_path):
    bomb = functools.partial(in_chunks_of, tmp_path / "bomb.mcap")
    large = bytes(65 * 2**20)
    chunk = Chunk("zstd", zstandard.compress(large), 0, 0, 0, len(large))
    unsaid = zstandard.ZstdCompressor(write_content_size=False).compress(large)
    small = dataclasses.replace(chunk, uncompressed_size=1000)
    for one, problem in [
        (chunk, "a chunk of 68157440 bytes"),
        (small, "larger than it says"),
        (dataclasses.replace(small, data=unsaid), "is damaged"),
    ]:
        with pytest.raises(BadInput, match=problem):
            read_drive(bomb(one))
    path = bomb(chunk)
    head, *_ = path.read_bytes().partition(b"\x0c")
    path.write_bytes(head + b"\x0c" + (2**40).to_bytes(8, "little"))
    with pytest.raises(BadInput, match=r"is damaged .* exceeds limit"):
        read_drive(path)
