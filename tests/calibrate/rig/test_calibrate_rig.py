"""A rig without common views is calibrated without a first guess, with the right uncertainty;
errors in the input are named."""

import dataclasses

import jax
import numpy as np
import pytest
import rig_rooms
from scipy import stats

from jaxnav.calibrate.rig import bundle
from jaxnav.calibrate.rig.calibrate import RigCalibration, calibrate_rig
from jaxnav.calibrate.rig.marker_check import checked, sizes_m
from jaxnav.calibrate.rig.vehicle_frame import moved_to_places
from jaxnav.calibrate.rig.views import (
    RigViews,
    Ts_vehicle_camera,
    both_poses,
    inverted,
    rays_camera,
    turn_rad,
    wxyz_xyz,
)
from jaxnav.errors import BadInput

FRAMES, NOISE_PX = 120, 0.3


@pytest.fixture(scope="module")
def world():
    rig = rig_rooms.qcar()
    Ts_world_marker, Ts_world_vehicle = rig_rooms.room(), rig_rooms.lemniscate(FRAMES)
    views = rig_rooms.views_of(rig, Ts_world_marker, Ts_world_vehicle, NOISE_PX, seed=1)
    return rig, Ts_world_marker, views


@pytest.fixture(scope="module")
def found(world) -> RigCalibration:
    rig, Ts_world_marker, views = world
    # All places but the reference camera's are nonsense.
    spoiled = rig_rooms.spoiled(rig, seed=3, m=3.0, deg=150.0)
    Ts = spoiled.Ts_camera_vehicle.wxyz_xyz.at[0].set(rig.Ts_camera_vehicle.wxyz_xyz[0])
    spoiled = dataclasses.replace(spoiled, Ts_camera_vehicle=type(rig.Ts_camera_vehicle)(Ts))
    return calibrate_rig(views, spoiled, {0: Ts_world_marker[0]}, 0)


def apart(Ts: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Largest distance in m and turn in degrees."""
    turns = [turn_rad(a, b) for a, b in zip(Ts, true, strict=True)]
    return float(np.linalg.norm((Ts - true)[:, :3, 3], axis=1).max()), float(
        np.rad2deg(np.max(turns))
    )


def test_cameras_and_markers_are_found_without_a_start(world, found):
    rig, Ts_world_marker, _ = world
    assert found.calibrated.all()
    assert found.mapped.all()
    far_m, far_deg = apart(found.Ts_vehicle_camera, Ts_vehicle_camera(rig))
    assert far_m < 1e-3
    assert far_deg < 0.05
    far_m, far_deg = apart(found.Ts_world_marker, Ts_world_marker)
    assert far_m < 0.02
    assert far_deg < 0.5
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.05)
    assert found.rms_px() == pytest.approx(NOISE_PX, rel=0.1)
    assert found.inflation == 1
    assert np.mean(found.weight < 1) < 0.01


def test_errors_are_as_large_as_the_covariance(world, found):
    rig, Ts_world_marker, _ = world
    true = np.concatenate([Ts_vehicle_camera(rig), Ts_world_marker])
    xi = rig_rooms.twists_to(np.concatenate([found.Ts_vehicle_camera, found.Ts_world_marker]), true)
    value, dof = rig_rooms.nees(found, xi, np.arange(xi.size))
    assert dof == 6 * (3 + 7)
    assert stats.chi2.ppf(1e-4, dof) < value < stats.chi2.ppf(1 - 1e-4, dof)


def test_a_frame_fitted_to_given_places_keeps_cameras_together(world, found):
    rig, *_ = world
    true = Ts_vehicle_camera(rig)
    tied = moved_to_places(found, true)
    between = [inverted(Ts[0]) @ Ts[1:] for Ts in (tied.Ts_vehicle_camera, found.Ts_vehicle_camera)]
    np.testing.assert_allclose(*between, atol=1e-9)
    seen = [
        T @ Ts[0] for T, Ts in ((of.Ts_world_vehicle, of.Ts_vehicle_camera) for of in (tied, found))
    ]
    np.testing.assert_allclose(*seen, atol=1e-9)
    # No camera is the gauge any more: each has its share of the uncertainty.
    assert np.all(tied.sigmas()[:4] > 0)
    value, dof = rig_rooms.nees(
        tied, rig_rooms.twists_to(tied.Ts_vehicle_camera, true), np.arange(24)
    )
    assert dof == 18
    assert value < stats.chi2.ppf(1 - 1e-4, dof)


def test_mirrored_poses_are_outvoted(world):
    """With 3 px the better fit of a sighting is the mirrored pose almost as often as not."""
    rig, Ts_world_marker, _ = world
    path, true = rig_rooms.lemniscate(FRAMES), Ts_vehicle_camera(rig)
    views = rig_rooms.views_of(rig, Ts_world_marker, path, 3.0, seed=1)
    pairs = both_poses(rays_camera(rig, views), views.size_m[views.marker])
    exact = inverted(true)[views.camera] @ inverted(path)[views.frame]
    exact = exact @ Ts_world_marker[views.marker]
    off = [[turn_rad(T, of) for T in pair] for pair, of in zip(pairs, exact, strict=True)]
    assert np.mean(np.diff(off, axis=1) < 0) > 0.35
    found = calibrate_rig(views, rig_rooms.spoiled(rig, 6), {0: Ts_world_marker[0]}, 0)
    assert found.calibrated.all()
    assert found.mapped.all()
    seen = found.Ts_world_vehicle @ found.Ts_vehicle_camera[0]
    assert max(map(turn_rad, seen, path @ true[0])) < np.deg2rad(20)


def test_wrong_sightings_count_little(world, found):
    rig, Ts_world_marker, views = world
    rng = np.random.default_rng(5)
    corners = views.corners_px.copy()
    wrong = rng.choice(len(views), len(views) // 10, replace=False)
    corners[wrong] += rng.normal(0, 30, (len(wrong), 1, 2))
    turned = rng.choice(len(views), len(views) // 20, replace=False)
    corners[turned] = np.roll(corners[turned], 1, axis=1)
    spoiled = dataclasses.replace(views, corners_px=corners)
    robust = calibrate_rig(spoiled, rig, {0: Ts_world_marker[0]}, 0)
    far_m, far_deg = apart(robust.Ts_vehicle_camera, Ts_vehicle_camera(rig))
    assert far_m < 1e-3
    assert far_deg < 0.05
    assert np.all(robust.weight[turned] < 1)
    assert np.median(robust.weight[turned]) < 0.05
    assert robust.sigma_px == pytest.approx(NOISE_PX, rel=0.3)


def test_what_nothing_links_stays_as_it_was_and_is_named(world):
    rig, Ts_world_marker, views = world
    # Camera 2 sees marker 7 alone, and nobody else does.
    alone = (views.camera == 2) == (views.marker == 7)
    found = calibrate_rig(views.only(alone), rig, {0: Ts_world_marker[0]}, 0)
    assert found.calibrated.tolist() == [True, True, False, True]
    assert found.mapped.tolist() == [True] * 7 + [False]
    given = Ts_vehicle_camera(rig)
    np.testing.assert_array_equal(found.Ts_vehicle_camera[2], given[2])
    assert not found.sigmas()[2].any()


def test_a_reference_that_sees_no_known_marker_is_refused(world):
    rig, Ts_world_marker, views = world
    kept = (views.marker != 0) & ~((views.camera == 1) & (views.marker != 7))
    with pytest.raises(BadInput, match="saw none of the known markers"):
        calibrate_rig(views.only(kept), rig, {0: Ts_world_marker[0]}, 0)


def small(rig, frames: int = 3) -> tuple[bundle.RigUnknowns, bundle.RigSightings]:
    Ts_world_marker, Ts_world_vehicle = rig_rooms.room(4), rig_rooms.lemniscate(40)[:frames]
    views = rig_rooms.views_of(rig, Ts_world_marker, Ts_world_vehicle, 0.5, seed=2)
    poses = bundle.RigUnknowns(
        wxyz_xyz(Ts_world_vehicle),
        wxyz_xyz(Ts_vehicle_camera(rig)),
        wxyz_xyz(Ts_world_marker),
        bundle.lenses_of(rig.cameras),
    )
    return poses, bundle.seen(rig, views, 1.0)


def test_blocks_are_those_of_the_whole_jacobian(world):
    rig, *_ = world
    poses, known = small(rig)
    F, R = poses.Ts_world_vehicle.shape[0], 6 * poses.sixes

    def residuals(move):
        moved = bundle.moved(poses, move[: 6 * F].reshape(F, 6), move[6 * F :])
        rows = bundle.reprojection_residuals_px(moved, known).reshape(-1)
        return rows, rows

    linearised = jax.jit(jax.jacfwd(residuals, has_aux=True))
    J, r = map(np.asarray, linearised(np.zeros(6 * F + R)))
    _, blocks = jax.jit(bundle.residuals_and_blocks)(poses, known)
    whole = J.T @ J
    for f in range(F):
        rows = slice(6 * f, 6 * f + 6)
        np.testing.assert_allclose(blocks.own[f], whole[rows, rows], rtol=1e-7, atol=1e-4)
        np.testing.assert_allclose(blocks.cross[f], whole[rows, 6 * F :], rtol=1e-7, atol=1e-4)
    np.testing.assert_allclose(blocks.shared, whole[6 * F :, 6 * F :], rtol=1e-7, atol=1e-4)
    gradient = np.concatenate([blocks.own_gradient.ravel(), blocks.shared_gradient])
    np.testing.assert_allclose(gradient, J.T @ r, rtol=1e-7, atol=1e-4)


def test_lenses_that_are_off_are_found_where_they_may_move(world):
    rig, Ts_world_marker, views = world
    shift = np.array([[3.0, 3.0, 2.0, -3.0, 0.01, *[0] * 7]] * 4)
    off = dataclasses.replace(
        rig, cameras=bundle.with_lenses(rig.cameras, bundle.lenses_of(rig.cameras) + shift)
    )
    kept = calibrate_rig(views, off, {0: Ts_world_marker[0]}, 0)
    found = calibrate_rig(views, off, {0: Ts_world_marker[0]}, 0, refine_lenses=True)
    assert kept.sigma_px > 1.5 * NOISE_PX
    assert kept.inflation > 3
    assert not kept.lens_sigmas().any()
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.05)
    assert found.inflation == 1
    error = np.asarray(bundle.lenses_of(found.cameras) - bundle.lenses_of(rig.cameras))
    sigma = found.lens_sigmas()
    assert np.all(sigma[:, :8] > 0)
    assert np.all(np.abs(error[:, :8]) < 4.5 * sigma[:, :8])
    assert np.all(sigma[:, :4] < 1.0)
    assert not error[:, 8].any()


@pytest.fixture(scope="module")
def freely(world) -> RigCalibration:
    """The map found by a rig that is known."""
    rig, Ts_world_marker, views = world
    return calibrate_rig(views, rig, {0: Ts_world_marker[0]}, None)


def held(world, freely: RigCalibration, views: RigViews, wrong: dict[int, np.ndarray]):
    rig, Ts_world_marker, _ = world
    given = {index: wrong.get(index, T) for index, T in enumerate(Ts_world_marker)}
    return checked(freely, views, rig, given, 0.02, np.deg2rad(3))


def test_a_right_map_is_found_right(world, freely):
    check = held(world, freely, world[2], {})
    assert check.agreeing == 8
    assert all(verdict.right for verdict in check.verdicts.values())
    for index, size in sizes_m(freely, world[2], world[0]).items():
        assert size == pytest.approx(rig_rooms.SIZE_M, rel=0.02), index


@pytest.mark.parametrize("index", [0, 3])
def test_a_marker_that_was_entered_wrongly_is_named(world, freely, index):
    """The gauge itself, or another one."""
    wrong = world[1][index].copy()
    wrong[:3, 3] += [0.0, 0.05, 0.02]
    check = held(world, freely, world[2], {index: wrong})
    assert [i for i, verdict in check.verdicts.items() if verdict.wrong] == [index]
    assert check.verdicts[index].apart_m == pytest.approx(0.054, abs=0.004)


def test_a_marker_that_moved_meanwhile_is_named(world, freely):
    rig, Ts_world_marker, views = world
    later = Ts_world_marker.copy()
    later[2, :3, 3] += [0.0, 0.12, 0.0]
    other = rig_rooms.views_of(rig, later, rig_rooms.lemniscate(FRAMES), NOISE_PX, seed=8)
    early = views.frame < 60
    late = other.frame >= 60
    both = dataclasses.replace(
        views,
        **{
            name: np.concatenate([getattr(views, name)[early], getattr(other, name)[late]])
            for name in ("frame", "camera", "marker", "corners_px")
        },
    )
    check = held(world, freely, both, {})
    assert check.verdicts[2].moved_m == pytest.approx(0.12, abs=0.02)
    assert [i for i, verdict in check.verdicts.items() if verdict.moved_m] == [2]


def test_a_size_that_is_ten_times_too_large_shows(world):
    rig, Ts_world_marker, views = world
    size_m = views.size_m.copy()
    size_m[5] *= 10
    wrong = dataclasses.replace(views, size_m=size_m)
    found = calibrate_rig(wrong, rig, {0: Ts_world_marker[0]}, None)
    assert sizes_m(found, wrong, rig)[5] == pytest.approx(rig_rooms.SIZE_M, rel=0.05)
    check = held(world, found, wrong, {})
    assert check.verdicts[5].wrong_size
