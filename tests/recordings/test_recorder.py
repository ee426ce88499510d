"""The recorder writes its input, and no caller waits for it, whatever happens to the disk."""

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from jaxnav.errors import BadInput
from jaxnav.recordings import recorder as recorder_module
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import input_message, outcome_message
from tests.helpers.drives import (
    make_input,
    make_outcome,
    make_picture,
    record_drive,
    same_input,
)

ROOT = Path(__file__).resolve().parents[2]


def _until(condition, timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it never came"
        time.sleep(0.005)


def put_inputs(recorder: Recorder, *indices: int) -> None:
    for index in indices:
        recorder.put(*input_message(make_input(index)))


def test_other_programs_can_read_the_file(tmp_path):
    path = tmp_path / "drive.mcap"
    recorder = Recorder(path, {"rig": "a rig"})
    record_drive(recorder, 30)
    recorder.close()
    assert (recorder.written, recorder.dropped, recorder.failed) == (63, 0, None)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        [metadata] = reader.iter_metadata()
        assert metadata.name == "jaxnav.drive"
        assert json.loads(metadata.metadata["header"]) == {"rig": "a rig"}
        messages = list(reader.iter_messages(log_time_order=False))
    counts = Counter((channel.topic, schema.name) for schema, channel, _ in messages)
    assert counts == {
        ("/odometry", "jaxnav.Odometry"): 10,
        ("/frames", "jaxnav.Frames"): 10,
        ("/tick", "jaxnav.Tick"): 10,
        ("/outcome", "jaxnav.Outcome"): 30,
        ("/camera/front", "foxglove.CompressedImage"): 3,
    }
    for schema, channel, message in messages:
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        assert json.loads(schema.data)["type"] == "object"
        content = json.loads(message.data)
        assert message.log_time == content.get("now_ns", message.log_time)
        if channel.topic == "/odometry":
            assert message.publish_time == content["stamp_ns"] == message.log_time - 7
    in_order = [m.log_time for _, channel, m in messages if channel.topic != "/camera/front"]
    assert in_order == sorted(in_order)
    for (topic, _), count in counts.items():
        sequences = [m.sequence for _, channel, m in messages if channel.topic == topic]
        assert sequences == list(range(count))


def test_images_are_foxgloves(tmp_path):
    path = tmp_path / "drive.mcap"
    recorder = Recorder(path, {})
    jpeg = cv2.imencode(".jpg", make_picture(50))[1].tobytes()
    recorder.image("/camera/front", 7_000_000_009, jpeg)
    recorder.image("/camera/rear", 8_000_000_000, make_picture(90))
    recorder.image("/camera/rear", -5, make_picture(90)[..., 0])
    recorder.close()
    with path.open("rb") as file:
        found = [
            json.loads(m.data) for _, _, m in make_reader(file).iter_messages(log_time_order=False)
        ]
    assert found[0]["timestamp"] == {"sec": 7, "nsec": 9}
    assert found[2]["timestamp"] == {"sec": 0, "nsec": 0}
    assert [image["frame_id"] for image in found] == ["front", "rear", "rear"]
    assert {image["format"] for image in found} == {"jpeg"}
    images = list(read_drive(path).images())
    assert images[0].jpeg == jpeg
    pixels = cv2.imdecode(np.frombuffer(images[1].jpeg, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_allclose(pixels, make_picture(90), atol=3)


def test_what_can_not_be_written_is_left_out(tmp_path):
    recorder = Recorder(tmp_path / "drive.mcap", {})
    recorder.image("/camera/front", 1, np.zeros((4, 4, 2), np.uint8))
    recorder.image("/camera/front", 2, np.zeros((0, 4), np.uint8))
    recorder.image("/camera/front", 3, None)
    recorder.put("/odometry", 4, {"now_ns": 4, "speed_mps": object()})
    recorder.put("/tick", 5, {"now_ns": "five"})
    put_inputs(recorder, 2)
    recorder.put("/own/topic", 2**70, {"anything": [1, 2]})
    recorder.close()
    assert (recorder.written, recorder.dropped, recorder.failed) == (2, 5, None)
    recorder.close()
    put_inputs(recorder, 1)
    assert recorder.dropped == 6  # after its end
    log = read_drive(tmp_path / "drive.mcap")
    assert not log.truncated
    assert len(log.inputs) == 1
    assert same_input(log.inputs[0], make_input(2))
    assert log.missing == {"/tick": 1}


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("missing/drive.mcap", "no such file or directory"),
        ("folder", "is a directory"),
        ("nul\0", "embedded null byte"),
    ],
)
def test_a_file_that_can_not_be_made_is_named(tmp_path, name, problem):
    (tmp_path / "folder").mkdir()
    with pytest.raises(BadInput, match=f"^{tmp_path}/.*: can't be written: {problem}"):
        Recorder(tmp_path / name, {})
    with pytest.raises(TypeError):  # a header that is no JSON is the caller's error
        Recorder(tmp_path / "drive.mcap", {"rig": object()})
    assert not (tmp_path / "drive.mcap").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_disk_that_is_full_from_the_start_is_named():
    with pytest.raises(BadInput, match=r"^/dev/full: can't be written: no space left on device"):
        Recorder("/dev/full", {})


def test_a_file_that_may_not_grow_ends_the_recording_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "drive.mcap"
    monkeypatch.setattr(recorder_module, "FLUSH_S", 0.01)
    recorder = Recorder(path, {"rig": "a rig"})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        for index in range(100_000):
            put_inputs(recorder, 3 * index)
            digest = os.urandom(999).hex()  # which does not compress
            recorder.put("/outcome", 1, outcome_message(make_outcome(index)) | {"digest": digest})
            if recorder.failed:
                break
            time.sleep(0.0005)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert recorder.failed == f"{path}: can't be written: file too large"
    dropped = recorder.dropped
    put_inputs(recorder, 0)
    assert recorder.dropped == dropped + 1
    recorder.close()
    log = read_drive(path)
    assert log.truncated
    assert log.header == {"rig": "a rig"}
    assert 0 < len(log.inputs) <= index + 1
    for index, given in enumerate(log.inputs):
        assert same_input(given, make_input(3 * index))


@pytest.fixture
def blocked(tmp_path, monkeypatch):
    """A recorder with room for 20 messages, 4 images among them, whose disk does not answer; and
    what makes it answer again."""
    entered, answer, write = threading.Event(), threading.Event(), recorder_module._File.write

    def stuck(file, data):
        if data:
            entered.set()
            answer.wait()
        return write(file, data)

    recorder = Recorder(tmp_path / "drive.mcap", {}, queue_messages=20, queue_images=4)
    monkeypatch.setattr(recorder_module._File, "write", stuck)
    monkeypatch.setattr(recorder_module, "FLUSH_S", 0.0)
    put_inputs(recorder, 0)
    assert entered.wait(10)
    yield recorder, answer
    answer.set()
    recorder.close()


def test_a_disk_that_does_not_answer_holds_nobody_up(blocked, tmp_path):
    recorder, answer = blocked
    put_inputs(recorder, *range(3, 3003, 3))
    assert recorder.dropped == 980
    assert recorder.failed is None
    begin_s = time.monotonic()
    recorder.close(timeout_s=0.1)
    assert time.monotonic() - begin_s < 5
    assert recorder.failed == f"{tmp_path / 'drive.mcap'}: the disk does not answer"
    answer.set()
    recorder.close()
    log = read_drive(tmp_path / "drive.mcap")
    assert [given.now_ns for given in log.inputs] == [
        make_input(3 * index).now_ns for index in range(21)
    ]


def test_a_gap_is_told(blocked, tmp_path):
    recorder, answer = blocked
    put_inputs(recorder, *range(3, 93, 3))
    answer.set()
    _until(lambda: recorder.written == 21)
    put_inputs(recorder, 99)
    recorder.close()
    log = read_drive(tmp_path / "drive.mcap")
    assert recorder.dropped == 10
    assert log.missing == {"/odometry": 10}
    assert same_input(log.inputs[-1], make_input(99))


def test_images_give_way_to_messages(blocked, tmp_path):
    recorder, answer = blocked
    for _ in range(8):
        recorder.image("/camera/front", 1, make_picture(1))
    assert recorder.dropped == 4  # no more than four wait
    put_inputs(recorder, *range(3, 51, 3))
    assert recorder.dropped == 4
    answer.set()
    recorder.close()
    log = read_drive(tmp_path / "drive.mcap")
    assert (len(log.inputs), len(list(log.images()))) == (17, 4)


def test_no_image_waits_behind_half_a_queue(blocked):
    recorder, _ = blocked
    put_inputs(recorder, *range(3, 33, 3))
    recorder.image("/camera/front", 1, make_picture(1))
    assert recorder.dropped == 1


def test_a_pipe_that_nobody_empties(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    recorder = Recorder(path, {}, queue_messages=50)
    try:

        def fill():
            digest = os.urandom(10_000).hex()  # which does not compress
            recorder.put("/outcome", 1, outcome_message(make_outcome(1)) | {"digest": digest})
            return recorder.dropped

        _until(fill)
        costs_s = []
        for _ in range(1000):
            begin_s = time.monotonic()
            put_inputs(recorder, 0)
            costs_s.append(time.monotonic() - begin_s)
        assert recorder.dropped == 1001
        assert np.median(costs_s) < 1e-3  # it takes some microseconds
        recorder.close(timeout_s=0.05)
    finally:
        os.close(reader)
    recorder.close()
    assert "broken pipe" in recorder.failed


CHILD = """
import sys, time
from jaxnav.drive.interfaces import Odometry
from jaxnav.recordings.records import input_message
from jaxnav.drive.pilot import Input
from jaxnav.recordings.recorder import Recorder

recorder = Recorder(sys.argv[1], {"rig": "a rig"})
for index in range(3000):
    now_ns = time.monotonic_ns()
    recorder.put(*input_message(Input(now_ns, Odometry(now_ns, 0.1 * index, 0.0))))
    print(now_ns, flush=True)
    time.sleep(0.01)
"""


def test_a_killed_program_leaves_all_but_the_last_second(tmp_path):
    path = tmp_path / "drive.mcap"
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path)],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        text=True,
    )
    with child:
        stamps_ns = [int(child.stdout.readline())]
        while stamps_ns[-1] - stamps_ns[0] < 1.8e9:
            stamps_ns.append(int(child.stdout.readline()))
        child.send_signal(signal.SIGKILL)
        stamps_ns += [int(line) for line in child.stdout.read().split()]
    log = read_drive(path)
    assert log.truncated
    assert log.header == {"rig": "a rig"}
    assert log.missing == {}
    recorded_ns = [given.now_ns for given in log.inputs]
    assert recorded_ns == stamps_ns[: len(recorded_ns)]
    assert recorded_ns[-1] > stamps_ns[-1] - 1e9
    assert all(
        later.odometry.speed_mps > earlier.odometry.speed_mps
        for earlier, later in pairwise(log.inputs)
    )
