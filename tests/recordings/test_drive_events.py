"""The events of a recorded drive: what the pilot has fused, in the order of the stamps."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from jaxnav.drive.flags import Reject
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import BadInput
from jaxnav.files import Route
from jaxnav.recordings.drive_events import DriveEvents, Event, believed_events, refused_odometry
from jaxnav.recordings.drive_log import DriveLog, read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.sim.bases import equipped
from jaxnav.vehicles.conformance.lockstep import Rates
from tests import worlds
from tests.helpers.simulated import make_setup, record, simulated


@pytest.fixture(scope="module")
def setup() -> DriveSetup:
    return make_setup()


@pytest.fixture(scope="module")
def drive(setup, tmp_path_factory) -> tuple[DriveLog, list[Outcome]]:
    """A second of driving, whose frames come late and one camera after the other."""
    return driven(setup, tmp_path_factory.mktemp("drive") / "drive.mcap", 1.0)


def driven(setup: DriveSetup, path: Path, duration_s: float) -> tuple[DriveLog, list[Outcome]]:
    steps = simulated(setup, duration_s, rates=Rates(camera_skew_s=0.004))
    record(path, setup.header(), [(step.input, step.outcome) for step in steps])
    return read_drive(path), [step.outcome for step in steps]


def test_events_of_a_drive_are_what_the_pilot_fused(setup, drive):
    are_what_the_pilot_fused(setup, *drive)


def test_readings_are_corrected_as_the_pilot_corrects_them(setup, tmp_path):
    """As the file of a calibrated car says; late stamps are moved back."""
    car = dataclasses.replace(
        setup.vehicle,
        speed_scale=1.1, steering_gain=0.9, steering_offset_rad=0.05, camera_delay_s=0.012,
    )  # fmt: skip
    calibrated = dataclasses.replace(setup, vehicle=car)
    log, outcomes = driven(calibrated, tmp_path / "drive.mcap", 0.3)
    are_what_the_pilot_fused(calibrated, log, outcomes, least=20)
    raw = [given.odometry.speed_mps for given in log.inputs if given.odometry]
    read = [e.data.odometry[0] for e in believed_events(log.inputs, calibrated) if e.data.odometry]
    np.testing.assert_allclose(read, 1.1 * np.array(raw))


@pytest.mark.long
def test_a_base_s_drive_has_its_twist_and_its_gyro(tmp_path):
    """Twists as read, and the turn of every interval as the base has turned in it."""
    base = equipped(worlds.qcar(), "differential", "consumer")
    route = Route(((2.6, -1.9), (0.50, 0.65)), 0.15, worlds.START_VIEW)  # it turns around
    setup = dataclasses.replace(make_setup(), vehicle=base, route=route)
    steps = simulated(setup, 1.5)
    record(tmp_path / "d.mcap", setup.header(), [(step.input, step.outcome) for step in steps])
    log = read_drive(tmp_path / "d.mcap")
    are_what_the_pilot_fused(setup, log, [step.outcome for step in steps])
    events = believed_events(log.inputs, setup)
    obs = DriveEvents.from_inputs(log.inputs, setup, log.path).obs
    told = np.array([event.data.odometry is not None for event in events])
    np.testing.assert_array_equal(obs.has_odometry, told)
    read = [event.data.odometry for event in events if event.data.odometry is not None]
    np.testing.assert_array_equal(obs.twist[told][:, [0, 1, 5]], read)
    np.testing.assert_array_equal(obs.twist[:, 2:5], 0)
    rate = obs.gyro_radps[:, 2]
    known = np.isfinite(rate)
    assert np.mean(known) > 0.95  # of the first intervals the gyro has not told
    heading = np.unwrap([step.truth[2] for step in steps])
    now_s = np.array([step.input.now_ns for step in steps]) / 1e9
    stamps_s = np.array([event.stamp_ns for event in events]) / 1e9
    turned = np.diff(np.interp(stamps_s, now_s, heading), prepend=np.nan)
    assert np.nanmax(heading) - np.nanmin(heading) > 0.2
    np.testing.assert_allclose((rate * obs.dt_s)[known], turned[known], atol=2e-3)


def are_what_the_pilot_fused(setup, log, outcomes, least=70):
    fused = [Event(o.stamp_ns, o.data) for o in outcomes if o.data is not None]
    assert any(b.stamp_ns < a.stamp_ns for a, b in itertools.pairwise(fused))
    fused.sort(key=lambda event: (event.stamp_ns, event.data.odometry is not None))
    events = believed_events(log.inputs, setup)
    assert len(events) == len(fused) > least
    for event, expected in zip(events, fused, strict=True):
        assert event.stamp_ns == expected.stamp_ns
        assert event.data.odometry == expected.data.odometry
        for name in ("corners_px", "visible", "sigma_px"):
            now, then = getattr(event.data, name), getattr(expected.data, name)
            assert (now is None) == (then is None)
            np.testing.assert_array_equal(now, then)


def test_odometry_that_was_refused_is_left_out(setup, drive):
    log, _ = drive
    bad = [reading for reading in log.inputs if reading.odometry is not None][20]
    now_ns = log.outcomes.now_ns
    rejects = np.where(now_ns == bad.now_ns, Reject.ODOMETRY, Reject(0)).astype(int)
    told = dataclasses.replace(log, outcomes=dataclasses.replace(log.outcomes, rejects=rejects))

    def readings(inputs, refused_ns=()) -> int:
        events = DriveEvents.from_inputs(inputs, setup, log.path, refused_ns)
        return int(events.obs.has_odometry.sum())

    every, others = (readings(log.inputs, refused_odometry(x)) for x in (log, told))
    assert others == every - 1
    for broken in (
        Odometry(bad.odometry.stamp_ns, np.nan, 0.0),
        Odometry(bad.odometry.stamp_ns, 0.1, 0.0, valid=False),
        Odometry(0, 0.1, 0.0),
    ):
        inputs = [dataclasses.replace(x, odometry=broken) if x is bad else x for x in log.inputs]
        assert readings(inputs) == others


def test_what_cameras_see_at_one_instant_is_one_event(setup, drive):
    log, _ = drive
    seen = next(x for x in log.inputs if x.frames and len(x.frames[0].detections))
    frame = seen.frames[0]
    cameras = [frame.camera, (frame.camera + 1) % 4]
    shown = [FrameDetections(camera, frame.stamp_ns, frame.detections) for camera in cameras]
    apart = [Input(seen.now_ns + k, frames=(one,)) for k, one in enumerate(shown)]
    (event,) = believed_events(apart, setup)
    assert event.data.visible.sum() == 2
    np.testing.assert_array_equal(
        event.data.corners_px[cameras[0]], event.data.corners_px[cameras[1]]
    )


def test_a_drive_that_shows_no_marker_is_refused(setup, drive):
    log, _ = drive
    blind = [dataclasses.replace(x, frames=()) for x in log.inputs]
    with pytest.raises(BadInput, match=r"drive\.mcap: .* none shows a marker of the map"):
        DriveEvents.from_inputs(blind, setup, log.path)
