"""Recordings for the tuning of a filter: no frame lost or repeated, each in its place."""

import dataclasses
import itertools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.commands.tune.drives import (
    Event,
    believed_events,
    sequences_of_drive,
    sequences_of_inputs,
)
from jaxnav.commands.tune.sequences import (
    GAP_S,
    NamedSequences,
    join_sequences,
    navigator_of,
    sequences_of_recording,
)
from jaxnav.datasets.recording import Recording
from jaxnav.datasets.recordings import read_recording
from jaxnav.errors import BadInput
from jaxnav.files import Route
from jaxnav.loop.flags import Reject
from jaxnav.loop.frames import FrameDetections
from jaxnav.loop.interfaces import Odometry
from jaxnav.loop.pilot import Input, Outcome
from jaxnav.models.geometry import rotation_error_rad
from jaxnav.recording.drive_log import DriveLog, read_drive
from jaxnav.recording.drive_setup import DriveSetup
from jaxnav.simulation.bases import equipped
from jaxnav.testing.lockstep import Rates
from jaxnav.tuning.branches import estimate_sequences, find_starts
from jaxnav.tuning.recorded import FrameSequences
from tests import worlds
from tests.helpers.simulated import make_setup, record, simulated

HALVES = [(0, 0.5), (0.5, 1)]


@pytest.fixture(scope="module")
def test_7(data_dir) -> Recording:
    return read_recording(data_dir / "tagslam" / "test_7" / "decoded.npz")


@pytest.fixture(scope="module")
def corner_sigma_px() -> float:
    return 0.18


def places(recording: Recording) -> dict[bytes, tuple[int, int, int]]:
    """Corners -> frame, camera and marker of the detection."""
    found = np.argwhere(recording.visible)
    places = {recording.corners_px[tuple(at)].tobytes(): tuple(map(int, at)) for at in found}
    assert len(places) == len(found)
    return places


def detections(recorded: FrameSequences) -> list[list[tuple[int, bytes]]]:
    """Of each sequence: frame of the sequence and corners."""
    corners_px, visible = np.asarray(recorded.obs.corners_px), np.asarray(recorded.obs.visible)
    return [
        [(int(at[0]), corners_px[(row, *at)].tobytes()) for at in np.argwhere(visible[row])]
        for row in range(len(recorded))
    ]


def long_enough(recording: Recording, begin: int, end: int, shortest: int) -> set[tuple]:
    """Frame, camera and marker of what is to be found when every marker is by itself."""
    kept = set()
    for marker in range(recording.visible.shape[2]):
        appearance: list[int] = []
        for frame in [*range(begin, end), None]:
            if frame is not None and not recording.visible[frame, :, marker].any():
                continue
            stamps_ns = recording.stamps_ns
            if frame is None or (
                appearance and stamps_ns[frame] - stamps_ns[appearance[-1]] > GAP_S * 1e9
            ):
                if len(appearance) >= shortest:
                    kept |= {
                        (seen, int(camera), marker)
                        for seen in appearance
                        for camera in np.flatnonzero(recording.visible[seen, :, marker])
                    }
                appearance = []
            appearance += [] if frame is None else [frame]
    return kept


@pytest.mark.parametrize("part", [*HALVES, (0.25, 0.7)])
def test_every_detection_is_in_one_appearance_of_its_marker(test_7, part):
    recorded = jax.device_get(sequences_of_recording(test_7, True, part))
    place_of = places(test_7)
    begin, end = (round(share * len(test_7)) for share in part)
    assert recorded.obs.visible.shape[2:] == (4, 1)
    assert recorded.used.shape[1] <= 64
    reference, count = test_7.reference, 0
    all_found = set()
    for row, found in enumerate(detections(recorded)):
        at = [place_of[corners] for _, corners in found]
        frames = np.unique([frame for frame, _, _ in at])
        used = int(recorded.used[row].sum())
        assert used == len(frames) >= 10
        assert np.all(recorded.used[row, :used])
        (marker,) = {marker for _, _, marker in at}
        pose, size_m = recorded.markers.Ts_world_marker.wxyz_xyz[row], recorded.markers.size_m[row]
        np.testing.assert_array_equal(pose[0], test_7.markers.Ts_world_marker.wxyz_xyz[marker])
        assert size_m == test_7.markers.size_m[marker]
        assert [index for index, _ in found] == [int(np.searchsorted(frames, a[0])) for a in at]
        np.testing.assert_array_equal(
            recorded.T_world_vehicle_true[row, :used], reference.T_world_vehicle[frames]
        )
        np.testing.assert_array_equal(recorded.judged[row, :used], reference.valid[frames])
        dt_s = np.asarray(recorded.obs.dt_s[row])
        np.testing.assert_array_equal(dt_s[1:used], np.diff(test_7.stamps_ns[frames]) / 1e9)
        assert dt_s[0] == 0
        assert np.all(dt_s <= GAP_S)
        all_found |= set(at)
        count += len(at)
    assert len(all_found) == count > 500
    assert all_found == long_enough(test_7, begin, end, 10)
    assert not np.any(recorded.judged & ~recorded.used)
    assert not np.any(recorded.obs.visible & ~recorded.used[..., None, None])
    assert np.all(np.isfinite(recorded.obs.corners_px))


def test_parts_that_adjoin_share_no_frame(test_7):
    place_of, frames = places(test_7), []
    for part in HALVES:
        found = detections(sequences_of_recording(test_7, True, part))
        frames.append({place_of[corners][0] for row in found for _, corners in row})
    assert max(frames[0]) < round(len(test_7) / 2) <= min(frames[1])


def test_all_markers_together_are_frame_after_frame(test_7):
    recorded, place_of = sequences_of_recording(test_7, False, (0, 1), length=40), places(test_7)
    assert recorded.obs.visible.shape[2:] == test_7.visible.shape[1:]
    assert recorded.markers.size_m.shape == (len(recorded), len(test_7.markers.ids))
    found = [[place_of[corners] for _, corners in row] for row in detections(recorded)]
    assert len(recorded) >= 9
    assert len({at for row in found for at in row}) == sum(map(len, found))
    for row, at in enumerate(found):
        frames = np.unique([frame for frame, _, _ in at])
        assert int(recorded.used[row].sum()) == frames[-1] - frames[0] + 1
        whole = test_7.visible[frames[0] : frames[-1] + 1]
        assert len(at) == whole.sum()


def test_a_frame_without_a_reference_is_not_judged(test_7):
    valid = np.zeros(len(test_7), bool)
    known = test_7.reference._replace(valid=valid)
    for reference in (known, None):
        recorded = sequences_of_recording(
            dataclasses.replace(test_7, reference=reference), True, (0, 0.5)
        )
        assert not recorded.judged.any()
        np.testing.assert_array_equal(recorded.T_world_vehicle_true[0, 0], [1, 0, 0, 0, 0, 0, 0])


def test_too_short_a_recording_says_what_is_needed(test_7):
    short = test_7.first(30)
    with pytest.raises(BadInput, match=r"^test_7: 15 of its 30 frames give 1 seq.* 4 are needed$"):
        sequences_of_recording(short, False, (0, 0.5))


def test_the_branch_that_is_chosen_is_the_true_one(test_7, corner_sigma_px):
    recorded = sequences_of_recording(test_7, True, (0, 1), length=12, shortest=6)
    rows = np.linspace(0, len(recorded) - 1, 20).astype(int)
    recorded = recorded.rows(rows)
    navigator = navigator_of(test_7, True, "multi-hypothesis", corner_sigma_px)
    start = find_starts(navigator, recorded)
    assert start.chosen.mean() >= 0.95
    first = jnp.argmax(estimate_sequences(navigator, recorded).decided, axis=1)
    truth = recorded.T_world_vehicle_true[np.arange(len(rows)), first]
    off_rad = jax.jit(jax.vmap(lambda a, b: rotation_error_rad(jaxlie.SE3(a), jaxlie.SE3(b))))(
        start.bank.mean[:, 0, :7], truth
    )
    assert np.mean(np.rad2deg(off_rad)[np.asarray(start.chosen)] < 10) >= 0.95


def test_recordings_are_put_together_padded_to_the_longest(test_7, corner_sigma_px):
    navigator = navigator_of(test_7, True, "multi-hypothesis", corner_sigma_px)
    parts = [
        sequences_of_recording(test_7, True, HALVES[0], 20),
        sequences_of_recording(test_7, True, HALVES[1], 32),
    ]
    both = jax.device_get(
        join_sequences(
            [NamedSequences(f"part {k}", navigator, part) for k, part in enumerate(parts)]
        )
    )
    assert both.used.shape == (sum(map(len, parts)), 32)
    assert int(both.used.sum()) == sum(int(part.used.sum()) for part in parts)
    for first, part in ((0, parts[0]), (len(parts[0]), parts[1])):
        some, length = both.rows(slice(first, first + len(part))), part.used.shape[1]
        for a, b in zip(jax.tree.leaves(some), jax.tree.leaves(part), strict=True):
            leaf = a if a.shape == b.shape else a[:, :length]
            np.testing.assert_array_equal(leaf, b)
        assert not some.obs.visible[:, length:].any()
        assert not some.judged[:, length:].any()
        assert not some.obs.dt_s[:, length:].any()


def test_recordings_that_do_not_go_together_are_named(test_7, corner_sigma_px):
    alone = sequences_of_recording(test_7, True, (0, 1))
    navigator = navigator_of(test_7, True, "multi-hypothesis", corner_sigma_px)
    one = NamedSequences("one", navigator, alone)
    all_markers = NamedSequences("other", navigator, sequences_of_recording(test_7, False, (0, 1)))
    with pytest.raises(BadInput, match=r"^one, other: must have as many markers .* 1 and 9$"):
        join_sequences([one, all_markers])
    visible = alone.obs.visible[:, :, :2]
    two_cameras = eqx.tree_at(lambda r: r.obs.visible, alone, visible)
    with pytest.raises(BadInput, match=r"^one, other: must have as many cameras .* 4 and 2$"):
        join_sequences([one, one._replace(name="other", recorded=two_cameras)])
    rig = dataclasses.replace(
        test_7.rig,
        Ts_camera_vehicle=jaxlie.SE3(test_7.rig.Ts_camera_vehicle.wxyz_xyz.at[0, 4].add(1e-3)),
    )
    moved = navigator_of(
        dataclasses.replace(test_7, rig=rig), True, "multi-hypothesis", corner_sigma_px
    )
    with pytest.raises(BadInput, match=r"^one, other: must have the same rig"):
        join_sequences([one, NamedSequences("other", moved, alone)])


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
    recorded = jax.device_get(sequences_of_drive(log, setup, (0, 1), length=200))
    obs = jax.tree.map(lambda leaf: leaf[0], recorded.obs)
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


def test_a_drive_is_its_events_one_by_one(setup, drive):
    log, _ = drive
    events = believed_events(log.inputs, setup)
    recorded = jax.device_get(sequences_of_drive(log, setup, (0, 1), length=30))
    used, obs = recorded.used, recorded.obs
    assert used.shape[1] <= 30
    assert int(used.sum()) == len(events)
    assert not recorded.judged.any()
    assert np.all(obs.dt_s[:, 0] == 0)
    begins = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    for row, begin in enumerate(begins[:-1]):
        of_row = events[begin : begins[row + 1]]
        stamps_s = np.array([event.stamp_ns // 1000 for event in of_row]) / 1e6
        dt_s = obs.dt_s[row, : len(of_row)]
        np.testing.assert_allclose(dt_s, np.diff(stamps_s, prepend=stamps_s[0]), atol=1e-9)
        for index, (_, told) in enumerate(of_row):
            assert bool(obs.has_odometry[row, index]) == (told.odometry is not None)
            if told.odometry is not None:
                assert float(obs.speed_mps[row, index]) == told.odometry[0]
                assert float(obs.steering_rad[row, index]) == told.odometry[1]
                assert not obs.visible[row, index].any()
            else:
                np.testing.assert_array_equal(obs.corners_px[row, index], told.corners_px)
                np.testing.assert_array_equal(obs.visible[row, index], told.visible)
                np.testing.assert_array_equal(obs.corner_sigma_px[row, index], told.sigma_px)
    halves = [sequences_of_drive(log, setup, part) for part in HALVES]
    assert sum(int(half.used.sum()) for half in halves) == len(events)
    both = join_sequences([NamedSequences("drive", setup.navigator(), half) for half in halves])
    assert len(both) == 2


def test_odometry_that_was_refused_is_left_out(setup, drive):
    log, _ = drive
    bad = [reading for reading in log.inputs if reading.odometry is not None][20]
    now_ns = log.outcomes.now_ns
    rejects = np.where(now_ns == bad.now_ns, Reject.ODOMETRY, Reject(0)).astype(int)
    told = dataclasses.replace(log, outcomes=dataclasses.replace(log.outcomes, rejects=rejects))
    counts = [int(sequences_of_drive(x, setup, (0, 1)).obs.has_odometry.sum()) for x in (log, told)]
    assert counts[1] == counts[0] - 1
    for broken in (
        Odometry(bad.odometry.stamp_ns, np.nan, 0.0),
        Odometry(bad.odometry.stamp_ns, 0.1, 0.0, valid=False),
        Odometry(0, 0.1, 0.0),
    ):
        inputs = [dataclasses.replace(x, odometry=broken) if x is bad else x for x in log.inputs]
        recorded = sequences_of_inputs(inputs, setup, log.path, (0, 1))
        assert int(recorded.obs.has_odometry.sum()) == counts[1]


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
        sequences_of_inputs(blind, setup, log.path, (0, 1))
