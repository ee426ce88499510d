"""What is left out: a marker that others have outvoted while it is alone in view, an id that two
cameras see at two places, and a camera that was knocked."""

import dataclasses

import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.navigator import Navigator
from jaxnav.drive.chassis import Motion
from jaxnav.drive.history import Sighting
from jaxnav.drive.outvoted import CameraVotes, MarkerVotes, Twins
from jaxnav.drive.standstill import Way
from tests import worlds

IDS = (7, 3, 12)


def told(*in_view: int, count: int = len(IDS)) -> Sighting:
    visible = np.zeros((2, count), bool)
    visible[0, list(in_view)] = True
    return Sighting(
        corners_px=np.zeros((2, count, 4, 2)), visible=visible, sigma_px=np.ones((2, count, 4))
    )


def voted(*which: int) -> np.ndarray:
    return np.isin(np.arange(3), which)


def test_one_that_was_outvoted_often_is_hidden_where_too_few_are_in_view_to_vote():
    votes, alone = MarkerVotes(IDS), told(2)
    assert votes.outvoted == ()
    for _ in range(10):
        assert votes.remove_outvoted(alone) is alone
        votes.count(told(0, 1, 2), voted(2))
        assert votes.outvoted == (12,)
    assert votes.remove_outvoted(alone) is None
    left = votes.remove_outvoted(told(0, 2))
    np.testing.assert_array_equal(left.visible.any(axis=0), [True, False, False])
    everything = told(0, 1, 2)
    assert votes.remove_outvoted(everything) is everything


def test_it_stays_named_while_others_are_in_view_or_none():
    votes = MarkerVotes(IDS)
    votes.count(told(0, 1, 2), voted(2))
    for seen in (told(0, 1), told(2), told()):
        votes.count(seen, voted())
        assert votes.outvoted == (12,)
    votes.count(told(0, 1, 2), voted())
    assert votes.outvoted == ()


def test_one_that_agrees_again_is_believed_again():
    votes, alone = MarkerVotes(IDS), told(0)
    for _ in range(100):
        votes.count(told(0, 1, 2), voted(0))
    for _ in range(11):
        assert votes.remove_outvoted(alone) is None
        votes.count(told(0, 1, 2), voted())
    assert votes.remove_outvoted(alone) is alone


@pytest.mark.parametrize(("ids", "in_view"), [((0,), 1), ((0, 1), 2), (IDS, 2)])
def test_frames_that_show_too_few_do_not_count(ids, in_view):
    """Also of a map that has no more."""
    votes, count = MarkerVotes(ids), len(ids)
    for _ in range(50):
        votes.count(told(*range(in_view), count=count), np.arange(count) < in_view)
    assert votes.outvoted == ()
    alone = told(0, count=count)
    assert votes.remove_outvoted(alone) is alone


MS = 1_000_000
RIG, MARKERS = worlds.qcar_rig(), worlds.paper_markers()
TURN_M = (2.0, -1.6, np.pi)  # brings a copy behind the vehicle at its start
ELSEWHERE = worlds.planar(*TURN_M).inverse()  # whoever sees the copy there sees the marker here


def navigator(rig=RIG) -> Navigator:
    selector = make_selector("paper-cost")
    return Navigator(rig=rig, markers=MARKERS, vehicle=worlds.qcar(), selector=selector)


def twins(rig=RIG) -> Twins:
    return Twins(navigator(rig))


def views(place, cameras=range(4), of_copy=(), noise_px: float = 0.0, seed: int = 0) -> Sighting:
    """What the cameras see from (x_m, y_m, psi_rad), some of them of the copy alone."""
    rng, T = np.random.default_rng(seed), worlds.planar(*place)
    truth, copy = worlds.observe(RIG, MARKERS, T), worlds.observe(RIG, MARKERS, ELSEWHERE @ T)
    of_copy = np.isin(np.arange(4), of_copy)[:, None]
    visible = np.where(of_copy, copy.visible, truth.visible)
    visible = visible & np.isin(np.arange(4), list(cameras))[:, None]
    corners_px = np.where(of_copy[:, :, None, None], copy.corners_px, truth.corners_px)
    corners_px = corners_px + noise_px * rng.standard_normal(corners_px.shape)
    return Sighting(corners_px=corners_px, visible=visible, sigma_px=np.ones((4, 1, 4)))


def standing(until_ns: int) -> Way:
    way = Way()
    for stamp_ns in range(0, until_ns + 1, 20 * MS):
        way.go(stamp_ns, Motion(0.0, 0.0, 0.0))
    return way


def test_one_id_in_two_cameras_at_two_places_is_left_out_from_the_first_frame():
    watch, way = twins(), standing(400 * MS)
    both = views(worlds.START_VIEW, of_copy=[2])
    assert both.visible[:, 0].tolist() == [True, False, True, False]
    assert watch.remove_twins(both, 20 * MS, way) is None
    assert watch.seen(20 * MS)
    # For a while it is not believed of one of them either.
    alone = views(worlds.START_VIEW, cameras=[0])
    assert watch.remove_twins(alone, 400 * MS, way) is None
    assert not watch.seen(2_000 * MS)


def test_what_was_contradicted_often_comes_back_when_cameras_agree():
    watch, way = twins(), standing(1_000 * MS)
    for frame in range(8):
        assert watch.remove_twins(views(worlds.START_VIEW, of_copy=[2]), 20 * MS, way) is None, (
            frame
        )
    alone, shared = views(worlds.START_VIEW, cameras=[0]), views(worlds.OVERLAP_VIEW)
    assert watch.remove_twins(alone, 10_000 * MS, way) is None
    assert watch.seen(10_000 * MS)
    for _ in range(20):
        watch.remove_twins(shared, 11_000 * MS, way)
    assert watch.remove_twins(alone, 12_000 * MS, way) is alone


def test_cameras_that_look_in_turn_are_compared_along_the_way():
    """The vehicle turns between two looks by far more than cameras may differ."""
    turning, rate_radps, still = Way(), 3.0, standing(400 * MS)
    for stamp_ns in range(0, 201 * MS, 20 * MS):
        turning.go(stamp_ns, Motion(0.0, 0.0, rate_radps))
    x_m, y_m, psi_rad = worlds.OVERLAP_VIEW
    first = views((x_m, y_m, psi_rad), cameras=[3])
    second = views((x_m, y_m, psi_rad + 0.2 * rate_radps), cameras=[0])
    assert first.visible.any()
    assert second.visible.any()
    # Without an odometer nothing is known of the way between. One that stands may have been
    # carried off, until the first camera contradicts that.
    for way in (turning, Way(), still):
        watch = twins()
        watch.remove_twins(first, 0, way)
        assert watch.remove_twins(second, 200 * MS, way) is second
    assert watch.remove_twins(second, 300 * MS, still) is second
    assert not watch.seen(300 * MS)
    assert watch.remove_twins(first, 400 * MS, still) is None


def test_what_calibration_and_noise_allow_is_one_place():
    """Cameras off by 1 deg and 1 cm, and each of them by 8 deg, wherever two see the marker."""
    rng, seen = np.random.default_rng(0), 0
    for draw in range(40):
        by_rad = np.deg2rad(8.0 if draw % 2 else 1.0)
        direction = rng.standard_normal((4, 2, 3))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        camera = np.arange(4) == draw % 4 if draw % 2 else np.ones(4)
        xi = np.concatenate([0.01 * direction[:, 0], by_rad * direction[:, 1]], axis=1)
        Ts = RIG.Ts_camera_vehicle @ jaxlie.SE3.exp(xi * camera[:, None])
        watch = twins(dataclasses.replace(RIG, Ts_camera_vehicle=Ts))
        for look in range(25):
            x_m, y_m = rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 0.6)
            told = views((x_m, y_m, rng.uniform(-np.pi, np.pi)), noise_px=2.0, seed=look)
            if told.visible.sum() > 1:
                watch.remove_twins(told, look * 10_000 * MS, Way())
                assert not watch.seen(look * 10_000 * MS)
                seen += 1
    assert seen > 200


def test_what_a_sure_estimate_judges_is_left_to_it():
    watch, way, both = twins(), standing(40 * MS), views(worlds.START_VIEW, of_copy=[2])
    assert watch.remove_twins(both, 20 * MS, way, judged=True) is both
    assert not watch.seen(20 * MS)
    assert watch.remove_twins(both, 20 * MS, way) is None


FRAME_NS = 66_000_000
FOCAL_PX = float(np.mean(RIG.cameras.focal_px))
DUE_PX = np.full((4, 1, 4, 2), 200.0)


@pytest.fixture
def votes():
    return CameraVotes(navigator())


def off(off_deg: dict[int, float]) -> Sighting:
    """What the cameras in view see, each of them off by an angle."""
    visible = np.isin(np.arange(4), list(off_deg))[:, None]
    angles = np.array([off_deg.get(camera, 0.0) for camera in range(4)])
    shift_px = FOCAL_PX * np.tan(np.deg2rad(angles))
    return Sighting(
        corners_px=DUE_PX + shift_px[:, None, None, None] * np.array([1.0, 0.0]),
        visible=visible,
        sigma_px=np.ones((4, 1, 4)),
    )


def count(votes, frames, begin_ns=0):
    for index, off_deg in enumerate(frames):
        votes.count(off(off_deg), DUE_PX, begin_ns + index * FRAME_NS)


@pytest.mark.parametrize("off_deg", [-90.1, -30.0, 8.0, 30.0])
@pytest.mark.parametrize("together", [True, False])
def test_one_that_was_knocked_loses_its_vote_before_the_filter_gives_up(votes, off_deg, together):
    frames = [{0: 0.2, 1: off_deg}] * 5 if together else [{1: off_deg}, {0: 0.2}] * 5
    count(votes, frames[:-1])
    assert votes.outvoted == ()
    count(votes, frames[-1:], len(frames) * FRAME_NS)
    assert votes.outvoted == ("right",)
    both = off({0: 0.0, 1: off_deg})
    left = votes.remove_outvoted(both)
    np.testing.assert_array_equal(left.visible.any(axis=1), [True, False, False, False])
    assert both.visible.sum() == 2
    assert votes.remove_outvoted(off({1: off_deg})) is None


@pytest.mark.parametrize(
    "frames",
    [
        [{0: 25.0, 1: 40.0}],  # carried off: no camera sees what it should
        [{1: 40.0}],  # the other sees nothing any more
        [{0: 4.0, 1: 7.0}],  # the estimate itself is off
        [{0: 0.0, 1: 4.0}],  # what the filter learns
    ],
)
def test_a_car_that_was_carried_off_blinds_no_camera(votes, frames):
    count(votes, [{0: 0.1}] * 10)
    count(votes, frames * 100, 10 * FRAME_NS)
    assert votes.outvoted == ()


def test_one_frame_from_before_accuses_once_and_nobody_whom_others_left_long_ago(votes):
    count(votes, [{1: 40.0}, {1: 40.0}, {1: 40.0}, {0: 0.1}, *[{1: 40.0}] * 50])
    assert votes.outvoted == ()
    assert votes._votes.tolist() == [0, 1, 0, 0]
    for index in range(50):
        votes.count(off({index % 2: 40.0 * (index % 2)}), DUE_PX, (index + 99) * 600_000_000)
    assert votes.outvoted == ()


def test_one_that_sees_what_it_should_gets_its_vote_back(votes):
    count(votes, [{0: 0.0, 1: 30.0}] * 1000)
    assert votes.outvoted == ("right",)
    count(votes, [{1: 30.0}] * 1000)  # alone it does not
    assert votes.outvoted == ("right",)
    count(votes, [{1: 1.0}] * 6, 1 << 50)
    assert votes.outvoted == ()


def test_it_is_asked_after_contradictions_and_while_a_camera_has_no_vote(votes):
    assert not votes.open(0)
    votes.note_contradiction(FRAME_NS)
    assert votes.open(2 * FRAME_NS)
    assert not votes.open(100 * FRAME_NS)
    count(votes, [{0: 0.0, 1: 30.0}] * 5)
    assert votes.open(100 * FRAME_NS)
