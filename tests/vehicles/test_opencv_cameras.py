"""Cameras by OpenCV: a video file in place of a device, and a device that misbehaves."""

import re
import threading
import time
from typing import ClassVar

import cv2
import numpy as np
import pytest

from jaxnav.drive.interfaces import Frame
from jaxnav.errors import BadInput
from jaxnav.vehicles import opencv_cameras
from jaxnav.vehicles.conformance import check_cameras
from jaxnav.vehicles.grabber import Grabber
from jaxnav.vehicles.opencv_cameras import open_cameras
from tests.helpers.setups import setup_with

RIG = setup_with().rig.first(2)
SIZE_PX = RIG.image_sizes_px[0]
RATE_HZ = 50.0
GREYS = [20 * i for i in range(1, 13)]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "drive.avi", SIZE_PX, GREYS)


def write_video(path, size_px, greys):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE_HZ, size_px)
    for grey in greys:
        writer.write(np.full((size_px[1], size_px[0], 3), grey, np.uint8))
    writer.release()
    return str(path)


def read_until_it_fails(camera):
    """The frames, each with its age when it came, and the error."""
    frames = []
    while True:
        try:
            frame = camera.read(1.0)
        except OSError as error:
            return frames, error
        frames.append((frame, time.monotonic_ns() - frame.stamp_ns))


def from_sources(front, right=None, **options):
    return open_cameras(
        setup_with(RIG, source__front=front, source__right=right or front, **options), None
    )


def test_video_files_keep_the_promises_of_cameras(video):
    check_cameras(open_cameras, setup_with(RIG, source__front=video, source__right=video))


def test_a_video_is_played_once_from_its_beginning_at_its_rate(video):
    capture = opencv_cameras._Capture("", video, SIZE_PX, 0)
    assert float(capture.grab().image.mean()) == pytest.approx(GREYS[0], abs=3)  # none is lost
    capture.release()
    front, right = from_sources(video, latency_ms="30")
    right.close()
    frames, error = read_until_it_fails(front)
    assert re.search(r"the camera front: .*drive.avi has no more pictures", str(error))
    front.close()
    frames = [frame for frame, age_ns in frames if age_ns >= 30_000_000]
    seen = [round(float(frame.image.mean()) / 20) * 20 for frame in frames]
    assert seen == sorted(set(seen))  # a picture may be missed on a busy machine
    assert len(seen) >= len(GREYS) / 2
    took_s = (frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9
    pictures = (seen[-1] - seen[0]) / 20
    assert took_s == pytest.approx(pictures / RATE_HZ, abs=0.1)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"source__front": "VIDEO"}, "--option source.right: missing"),
        (
            {"source__front": "VIDEO", "source__right": "VIDEO", "source__top": "0"},
            "--option source.top: the rig has no such camera: expected front, right",
        ),
        (
            {"source__front": "VIDEO", "source__right": "no.avi"},
            "there is no device or file",
        ),
        ({"source__front": "/dev/video987", "source__right": "VIDEO"}, "video987 can't be opened"),
        (
            {"source__front": "VIDEO", "source__right": "VIDEO", "latency_ms": "x"},
            "--option latency_ms: expected a number from 0 to 1000, got 'x'",
        ),
    ],
)
def test_a_wrong_source_is_one_line(video, options, problem, capfd):
    options = {key: video if value == "VIDEO" else value for key, value in options.items()}
    with pytest.raises(BadInput, match=problem):
        open_cameras(setup_with(RIG, **options), None)


def test_pictures_of_another_size_are_refused(video, tmp_path):
    small = write_video(tmp_path / "small.avi", (320, 240), GREYS[:2])
    problem = r"source.right: .*small.avi gives pictures of 320x240 px, the rig has 820x410"
    with pytest.raises(BadInput, match=problem):
        from_sources(video, small)


PIPELINE = "nvarguscamerasrc sensor-id=0 ! nvvidconv ! appsink"


class FakeCapture:
    """A V4L2 device with a cable. It stays open as the driver's does when the cable is out."""

    opened: ClassVar[list["FakeCapture"]] = []
    plugged = True

    def __init__(self, source, backend):
        self.source, self.backend, self.settings, self.released = source, backend, {}, False
        self.number = 0
        FakeCapture.opened.append(self)

    def isOpened(self):
        return FakeCapture.plugged

    def set(self, key, value):
        self.settings[key] = value
        return True

    def grab(self):
        time.sleep(0.01)
        return FakeCapture.plugged

    def retrieve(self):
        time.sleep(0.02)  # to decode takes time
        self.number += 1
        return True, np.full((SIZE_PX[1], SIZE_PX[0], 3), self.number % 256, np.uint8)

    def release(self):
        self.released = True


@pytest.fixture
def device(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    monkeypatch.setattr(FakeCapture, "opened", [])
    monkeypatch.setattr(FakeCapture, "plugged", True)
    monkeypatch.setattr("jaxnav.vehicles.grabber.RETRY_S", 0.1)
    return FakeCapture


def test_devices_keep_the_promises_of_cameras(device):
    check_cameras(open_cameras, setup_with(RIG, source__front="/dev/video0", source__right="2"))
    front, right = device.opened
    assert (front.source, right.source) == (0, 2)
    assert front.backend == right.backend == cv2.CAP_V4L2
    assert front.settings == {
        cv2.CAP_PROP_FRAME_WIDTH: SIZE_PX[0],
        cv2.CAP_PROP_FRAME_HEIGHT: SIZE_PX[1],
        cv2.CAP_PROP_BUFFERSIZE: 1,
    }
    assert front.released
    assert right.released


def test_gstreamer_gets_the_pipeline_where_it_is_built_in(device, monkeypatch):
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "  GStreamer:        NO\n")
    with pytest.raises(BadInput, match=r"source.front: this OpenCV was built without GStreamer"):
        from_sources(PIPELINE)
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "  GStreamer:        YES (1.20.3)\n")
    for camera in from_sources(PIPELINE):
        camera.close()
    assert device.opened[0].source == PIPELINE
    assert device.opened[0].backend == cv2.CAP_GSTREAMER
    assert device.opened[0].settings == {}


def test_the_stamp_is_of_the_grab_not_of_the_decoding(device):
    front, right = from_sources("0", "1")
    front.read(1.0)
    frame = front.read(1.0)
    assert time.monotonic_ns() - frame.stamp_ns >= 20_000_000
    front.close()
    right.close()


def test_an_unplugged_camera_is_an_oserror_and_comes_back(device):
    front, right = from_sources("0", "1")
    right.close()
    assert front.read(1.0) is not None
    device.plugged = False
    _, error = read_until_it_fails(front)
    assert "the camera front: 0 gives no pictures any more: is it unplugged?" in str(error)
    _, error = read_until_it_fails(front)
    assert "the camera front: 0 can't be opened" in str(error)
    device.plugged = True
    until_s = time.monotonic() + 5.0
    frame = None
    while frame is None and time.monotonic() < until_s:
        try:
            frame = front.read(0.5)
        except OSError:
            continue
    assert frame is not None
    front.close()
    assert all(capture.released for capture in device.opened)


def test_a_camera_that_fails_at_the_start_lets_the_others_go(device):
    with pytest.raises(BadInput, match=r"source.right: there is no device"):
        from_sources("0", "/dev/null")
    assert [capture.released for capture in device.opened] == [True]


def test_a_driver_that_hangs_neither_delays_a_read_nor_the_close():
    hangs, released = threading.Event(), threading.Event()
    grabber = Grabber("front", lambda: hangs.wait(10.0) and None, released.set)
    begin_s = time.monotonic()
    assert grabber.read(0.05) is None
    grabber.close()
    grabber.close()
    assert time.monotonic() - begin_s < 3.0
    with pytest.raises(OSError, match="the camera front is closed"):
        grabber.read(0.0)
    assert not released.is_set()  # not while the driver is inside
    hangs.set()
    assert released.wait(5.0)


def test_who_is_slow_gets_the_newest_frame_once():
    made = iter(range(1, 6))
    shown = threading.Event()

    def grab():
        number = next(made, None)
        if number is None:
            shown.set()
            return None
        return Frame(number, np.zeros((1, 1), np.uint8))

    grabber = Grabber("front", grab, lambda: None, pause_s=0.01)
    assert shown.wait(5.0)
    assert grabber.read(0.0).stamp_ns == 5
    assert grabber.read(0.02) is None
    grabber.close()


def test_whatever_a_driver_raises_is_an_oserror_and_does_not_end_it():
    failures = iter([ValueError("odd"), None])

    def grab():
        failure = next(failures, None)
        if failure is not None:
            raise failure
        return Frame(time.monotonic_ns(), np.zeros((1, 1), np.uint8))

    def release():
        raise ValueError("odd again")

    grabber = Grabber("front", grab, release)
    with pytest.raises(OSError, match="the camera front: ValueError: odd"):
        grabber.read(1.0)
    assert grabber.read(2.0) is not None
    grabber.close()
