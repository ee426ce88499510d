"""Recordings for the tuning of a filter: no frame lost or repeated, each in its place."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.commands.tune.data import (
    GAP_S,
    NamedSequences,
    join_sequences,
    navigator_of,
    sequences_of_drive,
    sequences_of_recording,
)
from jaxnav.core.models.geometry import rotation_error_rad
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.branches import estimate_sequences, find_starts
from jaxnav.experiments.tuning.recorded import FrameSequences
from jaxnav.recordings.drive_events import believed_events
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recording import Recording
from jaxnav.recordings.other.recordings import read_recording

HALVES = [(0, 0.5), (0.5, 1)]
PLAIN = Path(__file__).parents[2] / "data" / "drives" / "plain.mcap"


@pytest.fixture(scope="module")
def test_7(data_dir) -> Recording:
    return read_recording(data_dir / "tagslam" / "test_7" / "decoded.npz")


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


@pytest.mark.parametrize(
    "part", [(0.25, 0.7), *(pytest.param(half, marks=pytest.mark.long) for half in HALVES)]
)
def test_every_detection_is_in_one_appearance_of_its_marker(test_7, part):
    recorded = jax.device_get(sequences_of_recording(test_7, part))
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


def test_a_frame_without_a_reference_is_not_judged(test_7):
    valid = np.zeros(len(test_7), bool)
    known = test_7.reference._replace(valid=valid)
    for reference in (known, None):
        recorded = sequences_of_recording(
            dataclasses.replace(test_7, reference=reference), (0, 0.5)
        )
        assert not recorded.judged.any()
        np.testing.assert_array_equal(recorded.T_world_vehicle_true[0, 0], [1, 0, 0, 0, 0, 0, 0])


def test_too_short_a_recording_says_what_is_needed(test_7):
    short = test_7.first(16)
    with pytest.raises(BadInput, match=r"^test_7: 8 of its 16 frames give 0 seq.* 4 are needed$"):
        sequences_of_recording(short, (0, 0.5))


@pytest.mark.long
def test_the_branch_that_is_chosen_is_the_true_one(test_7):
    recorded = sequences_of_recording(test_7, (0, 1), length=12, shortest=6)
    rows = np.linspace(0, len(recorded) - 1, 20).astype(int)
    recorded = recorded.rows(rows)
    navigator = navigator_of(test_7, "multi-hypothesis", 0.18)
    start = find_starts(navigator, recorded)
    assert start.chosen.mean() >= 0.95
    first = jnp.argmax(estimate_sequences(navigator, recorded).decided, axis=1)
    truth = recorded.T_world_vehicle_true[np.arange(len(rows)), first]
    off_rad = jax.jit(jax.vmap(lambda a, b: rotation_error_rad(jaxlie.SE3(a), jaxlie.SE3(b))))(
        start.bank.mean[:, 0, :7], truth
    )
    assert np.mean(np.rad2deg(off_rad)[np.asarray(start.chosen)] < 10) >= 0.95


def test_recordings_are_put_together_padded_to_the_longest(test_7):
    navigator = navigator_of(test_7, "multi-hypothesis", 0.18)
    parts = [
        sequences_of_recording(test_7, HALVES[0], 20),
        sequences_of_recording(test_7, HALVES[1], 32),
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


def test_recordings_that_do_not_go_together_are_named(test_7):
    alone = sequences_of_recording(test_7, (0, 1))
    navigator = navigator_of(test_7, "multi-hypothesis", 0.18)
    one = NamedSequences("one", navigator, alone)
    visible = alone.obs.visible
    for what, counts, changed in (
        ("markers", "1 and 3", jnp.repeat(visible, 3, axis=3)),
        ("cameras", "4 and 2", visible[:, :, :2]),
    ):
        other = eqx.tree_at(lambda r: r.obs.visible, alone, changed)
        with pytest.raises(BadInput, match=rf"^one, other: must have as many {what} .* {counts}$"):
            join_sequences([one, one._replace(name="other", recorded=other)])
    rig = dataclasses.replace(
        test_7.rig,
        Ts_camera_vehicle=jaxlie.SE3(test_7.rig.Ts_camera_vehicle.wxyz_xyz.at[0, 4].add(1e-3)),
    )
    moved = navigator_of(dataclasses.replace(test_7, rig=rig), "multi-hypothesis", 0.18)
    with pytest.raises(BadInput, match=r"^one, other: must have the same rig"):
        join_sequences([one, NamedSequences("other", moved, alone)])


def test_a_drive_is_its_events_one_by_one():
    log = read_drive(PLAIN)
    setup = DriveSetup.from_header(log.header, PLAIN)
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


def test_a_part_that_shows_no_marker_is_refused():
    log = read_drive(PLAIN)
    setup = DriveSetup.from_header(log.header, PLAIN)
    half = len(log.inputs) // 2
    blind = [dataclasses.replace(given, frames=()) for given in log.inputs[:half]]
    late = dataclasses.replace(log, inputs=[*blind, *log.inputs[half:]])
    sequences_of_drive(late, setup, (0.3, 1))
    with pytest.raises(BadInput, match=r"plain\.mcap: .* of its .* none shows a marker of the map"):
        sequences_of_drive(late, setup, (0, 0.3))
