"""The expected places of markers against poses sampled one by one from the belief."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.core.filter.bank import empty_bank
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.detection.observe import marker_keys
from jaxnav.drive.expect import MARGIN_PX, Expectation, Expected, expect_corners
from tests.worlds import observe, qcar_rig, room_markers

RIG, MARKERS = qcar_rig(), room_markers()
SAMPLES = 4000
MEANS = [(0.1, 0.2, 1.5), (-0.4, -0.3, 0.2), (0.7, 0.1, -2.0)]
# sigma x m, y m, psi rad, and the correlation of x with psi
BELIEFS = {
    "sharp": (0.005, 0.01, 0.005, 0.0),
    "usual": (0.03, 0.02, 0.02, 0.7),
    "blunt": (0.1, 0.1, 0.08, -0.5),
}


def covariance_of(
    sigma_x: float, sigma_y: float, sigma_psi: float, correlation: float
) -> np.ndarray:
    covariance = np.diag([sigma_x**2, sigma_y**2, sigma_psi**2])
    covariance[0, 2] = covariance[2, 0] = correlation * sigma_x * sigma_psi
    return covariance


@jax.jit
@jax.vmap
def seen(pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Corners and visibility from a pose x_m, y_m, psi_rad; hidden corners where they would be."""
    T_world_vehicle = T_world_vehicle_from_planar(pose)
    corners_px = RIG.project(T_world_vehicle.inverse(), MARKERS.corners_world_m)
    return corners_px, observe(RIG, MARKERS, T_world_vehicle).visible


def expect(
    pose: tuple[float, float, float], covariance: np.ndarray, margin_px: float = 0.0
) -> Expected:
    T_world_vehicle = T_world_vehicle_from_planar(jnp.asarray(pose, float)).wxyz_xyz
    return expect_from(T_world_vehicle, covariance, margin_px)


def expect_from(
    T_world_vehicle: jax.Array, covariance: np.ndarray, margin_px: float = 0.0
) -> Expected:
    """As numpy. Always called alike, so that it is compiled once."""
    arguments = T_world_vehicle, jnp.asarray(covariance), jnp.asarray(margin_px)
    return jax.device_get(expect_corners(RIG, MARKERS, *arguments))


@pytest.mark.parametrize(("mean", "belief"), list(zip(MEANS, BELIEFS, strict=True)))
def test_corners_are_where_they_are_looked_for(mean, belief):
    covariance = covariance_of(*BELIEFS[belief])
    rng = np.random.default_rng(1)
    poses = rng.multivariate_normal(mean, covariance, SAMPLES)
    corners_px, visible = jax.device_get(seen(jnp.asarray(poses)))
    quads_px, expected_visible, radius_px = expect(mean, covariance)
    far_px = np.linalg.norm(corners_px - quads_px, axis=-1).max(axis=-1)
    assert expected_visible.any()
    for lane in zip(*np.nonzero(visible.any(axis=0)), strict=True):
        shown = visible[(slice(None), *lane)]
        # What is seen more than now and then is expected, and found inside the circle.
        assert expected_visible[lane] or shown.mean() < 0.01
        outside = far_px[(slice(None), *lane)] > radius_px[lane]
        assert np.mean(shown & outside) < 0.006
    for lane in zip(*np.nonzero(expected_visible & (visible.mean(axis=0) > 0.9)), strict=True):
        # And the circle is no larger than it must be: along one axis 3 sigma, on all sides 4.2.
        assert radius_px[lane] < 2.2 * np.quantile(far_px[(slice(None), *lane)], 0.99)


def test_a_pose_that_is_known_leaves_the_margin():
    for mean in MEANS:
        quads_px, visible, radius_px = expect(mean, np.zeros((3, 3)))
        corners_px, truly = jax.device_get(seen(jnp.asarray(np.tile(mean, (SAMPLES, 1)))))
        np.testing.assert_allclose(quads_px, corners_px[0], atol=1e-9)
        np.testing.assert_array_equal(visible, truly[0])
        np.testing.assert_allclose(radius_px, 0, atol=1e-9)
        np.testing.assert_allclose(expect(mean, np.zeros((3, 3)), 2.5).radius_px, 2.5, atol=1e-9)


def test_a_tilted_vehicle_keeps_its_tilt():
    tilt = Rotation.from_euler("zyx", [1.5, 0.03, -0.04])
    T_world_vehicle = jnp.asarray([*np.roll(tilt.as_quat(), 1), 0.1, 0.2, 0.05])
    truth = projected(T_world_vehicle)
    np.testing.assert_allclose(
        expect_from(T_world_vehicle, np.zeros((3, 3))).quads_px, truth, atol=1e-9
    )
    # A step along y is one of the vehicle's, not of a level one's.
    sigma_y = np.diag([0.0, 0.01**2, 0.0])
    there = projected(T_world_vehicle.at[5].add(0.03))
    back = projected(T_world_vehicle.at[5].add(-0.03))
    far_px = [np.linalg.norm(np.asarray(moved - truth), axis=-1) for moved in (there, back)]
    np.testing.assert_allclose(
        expect_from(T_world_vehicle, sigma_y).radius_px, np.max(far_px, axis=(0, -1)), atol=1e-9
    )


@jax.jit
def projected(T_world_vehicle: jax.Array) -> jax.Array:
    return RIG.project(jaxlie.SE3(T_world_vehicle).inverse(), MARKERS.corners_world_m)


def test_any_covariance_gives_an_answer():
    singular = np.outer([0.1, 0.0, 0.1], [0.1, 0.0, 0.1])
    lost = np.diag([1e6, 1e6, 1e4])
    turned = np.diag([0.0, 0.0, (2 * np.pi / 3) ** 2])  # three sigma are a whole turn
    for covariance in (singular, lost, turned):
        found = expect(MEANS[0], covariance)
        assert np.isfinite(found.quads_px).all()
        assert np.isfinite(found.radius_px).all()
        assert found.visible.any()
    assert (expect(MEANS[0], turned).radius_px > 300).all()
    unknown = expect(MEANS[0], np.full((3, 3), np.nan))
    assert not unknown.visible.any()


NAVIGATOR = SimpleNamespace(rig=RIG, markers=MARKERS, corner_sigma_px=np.array(1.0))
POSES = np.array([[0.1, 0.2, 1.5], [-0.4, -0.3, 0.2], [0.7, 0.1, -2.0], [0, 0, 0]])
WEIGHTS = np.array([0.2, 0.5, 0.3, 0.0])  # of the last nothing is known
TOLD_NS = 1_000_000_000


def told(decided: bool, located: bool = True, now_ns: int = TOLD_NS, shift_m: float = 0.0):
    """What the pilot gives: poses POSES, of which the second is the heaviest."""
    bank = jax.device_get(empty_bank(jnp.zeros(6), 1e-4 * jnp.eye(6), 3, len(POSES)))
    mean = bank.mean.copy()
    mean[:, :3] = POSES + np.array([shift_m, 0, 0])
    with np.errstate(divide="ignore"):
        of_bank = mean, np.log(WEIGHTS), WEIGHTS > 0
    bank = eqx.tree_at(lambda b: (b.mean, b.log_weight, b.initialised), bank, of_bank)
    output = SimpleNamespace(
        decided=decided,
        located=located,
        T_world_vehicle=jax.device_get(T_world_vehicle_from_planar(jnp.asarray(mean[1, :3]))),
        pose_covariance=bank.covariance[1, :3, :3],
    )
    return output, bank, now_ns


def seen_from(poses, covariance) -> list[tuple[tuple[str, int], np.ndarray]]:
    """Key and corners of each marker that camera 0 may see from each pose."""
    seen = []
    for pose in poses:
        expected = expect(pose, covariance, MARGIN_PX)
        for m in np.flatnonzero(expected.visible[0]):
            seen.append((marker_keys(MARKERS)[m], expected.quads_px[0, m]))
    return seen


def test_markers_are_expected_by_every_hypothesis_until_one_is_decided():
    expectation = Expectation(NAVIGATOR)
    assert expectation.region(0) is None
    expectation.update(*told(decided=False, located=False))
    assert expectation.region(0) is None
    covariance = np.diag([1e-4] * 3) + np.diag([1e-4, 1e-4, np.deg2rad(0.5) ** 2])
    expectation.update(*told(decided=False))
    region = expectation.region(0)
    assert not region.decided
    assert region.flow_px_s is None
    expected = seen_from(POSES[[1, 2, 0]], covariance)  # by weight
    assert len(expected) > len(seen_from(POSES[[1]], covariance)) > 0
    assert list(region.keys) == [key for key, _ in expected]
    np.testing.assert_allclose(region.quads_px, [quad for _, quad in expected], atol=1e-6)
    expectation.update(*told(decided=True))
    region = expectation.region(0)
    assert region.decided
    expected = seen_from(POSES[[1]], covariance)
    np.testing.assert_allclose(region.quads_px, [quad for _, quad in expected], atol=1e-6)


def test_a_motion_is_that_between_two_decided_poses():
    expectation, later_ns = Expectation(NAVIGATOR), TOLD_NS + 50_000_000
    expectation.update(*told(decided=False, shift_m=-0.01))
    expectation.update(*told(decided=True))
    assert expectation.region(0).flow_px_s is None
    before_px = expectation.region(0).quads_px
    expectation.update(*told(decided=True, now_ns=later_ns, shift_m=0.01))
    region = expectation.region(0)
    moved_px = np.mean(region.quads_px - before_px, axis=1)
    np.testing.assert_allclose(region.flow_px_s, moved_px / 0.05, rtol=1e-6)
    assert np.max(np.abs(moved_px)) > 0.5
