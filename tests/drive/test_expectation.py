"""Where markers are expected while it is not decided which of several poses is right."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.core.filter.bank import empty_bank
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.detection.observe import marker_keys
from jaxnav.drive.expect import expect_corners
from jaxnav.drive.expectation import Expectation
from tests.worlds import qcar_rig, room_markers

NAVIGATOR = SimpleNamespace(rig=qcar_rig(), markers=room_markers(), corner_sigma_px=np.array(1.0))
POSES = np.array([[0.1, 0.2, 1.5], [-0.4, -0.3, 0.2], [0.7, 0.1, -2.0], [0, 0, 0]])
WEIGHTS = np.array([0.2, 0.5, 0.3, 0.0])  # of the last nothing is known
TOLD_NS = 1_000_000_000


def outcome(decided: bool, located: bool = True, now_ns: int = TOLD_NS, shift_m: float = 0.0):
    """What the pilot gives: poses POSES, of which the second is the heaviest."""
    bank = jax.device_get(empty_bank(jnp.zeros(6), 1e-4 * jnp.eye(6), 3, len(POSES)))
    mean = bank.mean.copy()
    mean[:, :3] = POSES + np.array([shift_m, 0, 0])
    with np.errstate(divide="ignore"):
        told = mean, np.log(WEIGHTS), WEIGHTS > 0
    bank = eqx.tree_at(lambda b: (b.mean, b.log_weight, b.initialised), bank, told)
    output = SimpleNamespace(
        decided=decided,
        located=located,
        T_world_vehicle=jax.device_get(T_world_vehicle_from_planar(jnp.asarray(mean[1, :3]))),
        pose_covariance=bank.covariance[1, :3, :3],
    )
    return SimpleNamespace(output=output, belief=SimpleNamespace(bank=bank), now_ns=now_ns)


def seen_from(poses, covariance) -> list[tuple[tuple[str, int], np.ndarray]]:
    """Key and corners of each marker that camera 0 may see from each pose."""
    seen = []
    for pose in poses:
        expected = jax.device_get(
            expect_corners(
                NAVIGATOR.rig,
                NAVIGATOR.markers,
                np.asarray(T_world_vehicle_from_planar(jnp.asarray(pose)).wxyz_xyz),
                covariance,
            )
        )
        for m in np.flatnonzero(expected.visible[0]):
            seen.append((marker_keys(NAVIGATOR.markers)[m], expected.quads_px[0, m]))
    return seen


def test_markers_are_expected_by_every_hypothesis_until_one_is_decided():
    expectation = Expectation(NAVIGATOR)
    assert expectation.region(0) is None
    expectation.update(outcome(decided=False, located=False))
    assert expectation.region(0) is None
    covariance = np.diag([1e-4] * 3) + np.diag([1e-4, 1e-4, np.deg2rad(0.5) ** 2])
    expectation.update(outcome(decided=False))
    region = expectation.region(0)
    assert not region.decided
    assert region.flow_px_s is None
    expected = seen_from(POSES[[1, 2, 0]], covariance)  # by weight
    assert len(expected) > len(seen_from(POSES[[1]], covariance)) > 0
    assert list(region.keys) == [key for key, _ in expected]
    np.testing.assert_allclose(region.quads_px, [quad for _, quad in expected], atol=1e-6)
    expectation.update(outcome(decided=True))
    region = expectation.region(0)
    assert region.decided
    expected = seen_from(POSES[[1]], covariance)
    np.testing.assert_allclose(region.quads_px, [quad for _, quad in expected], atol=1e-6)


def test_a_motion_is_that_between_two_decided_poses():
    expectation, later_ns = Expectation(NAVIGATOR), TOLD_NS + 50_000_000
    expectation.update(outcome(decided=False, shift_m=-0.01))
    expectation.update(outcome(decided=True))
    assert expectation.region(0).flow_px_s is None
    before_px = expectation.region(0).quads_px
    expectation.update(outcome(decided=True, now_ns=later_ns, shift_m=0.01))
    region = expectation.region(0)
    moved_px = np.mean(region.quads_px - before_px, axis=1)
    np.testing.assert_allclose(region.flow_px_s, moved_px / 0.05, rtol=1e-6)
    assert np.max(np.abs(moved_px)) > 0.5
