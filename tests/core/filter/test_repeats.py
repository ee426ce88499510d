"""Repeated sightings against the variance of a mean of correlated errors, and the share learnt."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter.bank import PoseBelief
from jaxnav.core.filter.errors import RepeatedErrors, Repeats, surprise_of, unexplained
from jaxnav.core.models.geometry import OFF_GROUND, ON_GROUND, cayley
from jaxnav.core.pose.observation import Snapshot
from jaxnav.core.pose.refine import Candidates
from jaxnav.sim.corners import drifted, see
from tests import worlds
from tests.derivatives import in_float32

SIGMA_PX, SHARE = 0.5, 0.3
MODEL = RepeatedErrors(least_share=SHARE, most_share=SHARE, renewal_px=40.0)
LEARNS = RepeatedErrors(most_share=0.9)
FRAMES = 300  # of a drive, 10 s
YES = jnp.asarray(True)
CORRELATION = 0.975  # of repeated errors, from frame to frame


def snapshot(shift_px=0.0, visible=True) -> Snapshot:
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    return shoot(rig, markers, worlds.observe(rig, markers, pose()), shift_px, visible)


def with_corners(shot: Snapshot, corners_px) -> Snapshot:
    return dataclasses.replace(shot, seen=dataclasses.replace(shot.seen, corners_px=corners_px))


@jax.jit
def shoot(rig, markers, obs, shift_px, visible) -> Snapshot:
    obs = dataclasses.replace(
        obs,
        corners_px=obs.corners_px + jnp.asarray([shift_px, 0.0]).reshape(1, 1, 1, 2),
        visible=obs.visible & visible,
    )
    return Snapshot.create(rig, markers, obs, SIGMA_PX)


def pose() -> jaxlie.SE3:
    return worlds.planar(*worlds.FRONT_VIEW)


def nothing() -> Repeats:
    return MODEL.begin(worlds.qcar_rig(), worlds.paper_markers())


@jax.jit
def weigh(repeats, shot):
    seen = MODEL.weighed(repeats, shot).seen
    after = MODEL.after(repeats, shot, pose(), YES)
    return jnp.max(jnp.where(seen.visible, seen.sigma_px[:, 0], 0)), after


def test_a_parked_car_s_sightings_add_up_to_the_mean_of_correlated_errors():
    """Their weights 1 / sigma_n^2 sum to the inverse variance of the mean of n equal-correlated
    errors, 1 / (sigma^2 ((1 - s) / n + s))."""
    repeats, weights = nothing(), []
    for n in range(1, 31):
        sigma_px, repeats = weigh(repeats, snapshot())
        weights.append(float(sigma_px) ** -2)
        covariance = SIGMA_PX**2 * ((1 - SHARE) * np.eye(n) + SHARE)
        information = np.ones(n) @ np.linalg.solve(covariance, np.ones(n))
        assert sum(weights) == pytest.approx(information, rel=1e-9)
    assert weights[0] == pytest.approx(SIGMA_PX**-2)
    assert sum(weights) < 1 / (SHARE * SIGMA_PX**2)


def test_what_has_moved_counts_anew():
    _, repeats = weigh(nothing(), snapshot())
    near, far = (float(weigh(repeats, snapshot(shift))[0]) for shift in (4.0, 400.0))
    assert far == pytest.approx(SIGMA_PX, rel=1e-4)
    n = np.exp(-4.0 / 40.0)
    growth = (1 - SHARE + (n + 1) * SHARE) * (1 - SHARE + n * SHARE) / (1 - SHARE)
    assert near == pytest.approx(SIGMA_PX * np.sqrt(growth))


def test_what_surprises_counts_anew():
    """By n / surprise^2: at four times the bound a repeated sighting is new but for a sixteenth."""
    _, repeats = weigh(nothing(), snapshot())
    weighed = jax.jit(MODEL.weighed)
    one, four = (weighed(repeats, snapshot(), by).seen.sigma_px[0, 0] for by in (1.0, 4.0))
    n = 1 / 16
    growth = (1 - SHARE + (n + 1) * SHARE) * (1 - SHARE + n * SHARE) / (1 - SHARE)
    assert float(four) == pytest.approx(SIGMA_PX * np.sqrt(growth))
    assert float(one) > 1.2 * float(four)


@jax.jit
def predicted(off, sigma, alive=True) -> PoseBelief:
    """Two hypotheses, the second one off by (m, m, rad) with sigmas of its own."""
    freedom = jnp.asarray(ON_GROUND, float)
    covariance = freedom @ jnp.diag(jnp.asarray(sigma) ** 2) @ freedom.T
    there = pose() @ cayley(freedom @ jnp.asarray(off, float))
    return PoseBelief(
        jaxlie.SE3(jnp.stack([worlds.planar(*worlds.NO_VIEW).wxyz_xyz, there.wxyz_xyz])),
        jnp.stack([jnp.eye(6), covariance]),
        jnp.log(jnp.asarray([0.1, 0.9])),
        jnp.asarray([True, alive]),
        freedom,
        jnp.asarray(OFF_GROUND * np.array([0.002, 0.005, 0.005])),
        21.1,
    )


def surprise(belief, free_cost=0.0, valid=True):
    candidates = Candidates.none(2, jnp.zeros(()).dtype)
    candidates = dataclasses.replace(
        candidates, cost=jnp.asarray([free_cost, 0.0]), valid=jnp.asarray([valid, False])
    )
    return float(jax.jit(surprise_of)(belief, jnp.asarray(1), candidates, snapshot()))


def test_the_surprise_is_the_nis_of_the_prediction_over_its_bound():
    """Against r' (I + J P J')^-1 r with numeric derivatives by the vehicle's pose."""
    off, sigma = np.array([0.2, -0.1, 0.1]), np.array([0.01, 0.02, 0.005])
    belief, shot = predicted(off, sigma), snapshot()
    T = jaxlie.SE3(belief.T_world_vehicle.wxyz_xyz[1])
    shown = np.asarray(shot.seen.visible)

    @jax.jit
    def residual(xi):
        corners_px = shot.rig.project((T @ cayley(xi)).inverse(), shot.markers.corners_world_m)
        at = corners_px[shot.seen.camera_index, shot.seen.marker_index]
        r = (at - shot.seen.corners_px) / shot.seen.sigma_px[..., None]
        return r[shown].reshape(-1)

    r = np.asarray(residual(jnp.zeros(6)))
    J = np.asarray(jax.jit(jax.jacfwd(residual))(jnp.zeros(6)))
    spread = np.hstack([np.asarray(ON_GROUND) * sigma, np.asarray(belief.nuisance)])
    S = np.eye(r.size) + J @ spread @ spread.T @ J.T
    nis, bound = r @ np.linalg.solve(S, r), 6 + 3 * np.sqrt(12)
    assert nis > 2 * bound
    assert surprise(belief) == pytest.approx(nis / bound, rel=1e-6)
    assert surprise(belief, free_cost=10.0) == pytest.approx((nis - 10) / bound, rel=1e-6)


def test_nothing_surprises_who_expects_it_or_knows_nothing():
    off, sure, unsure = [0.2, -0.1, 0.1], [0.01, 0.02, 0.005], [0.3, 0.3, 0.3]
    assert surprise(predicted([0.0] * 3, sure)) == 1
    assert surprise(predicted(off, unsure)) == 1
    assert surprise(predicted(off, sure, alive=False)) == 1
    assert surprise(predicted(off, sure), valid=False) == 1


def test_a_pause_changes_nothing():
    """The errors of the last sighting are those of the next at the same place."""
    _, seen = weigh(nothing(), snapshot())
    _, after = weigh(seen, snapshot(visible=False))
    for now, before in zip(jax.tree.leaves(after), jax.tree.leaves(seen), strict=True):
        np.testing.assert_array_equal(now, before)


def test_white_errors_are_told_by_a_share_of_nothing():
    repeats, white = nothing(), RepeatedErrors(0.0, 0.0)
    weighed, after = jax.jit(white.weighed), jax.jit(white.after)
    for _ in range(5):
        seen = weighed(repeats, snapshot()).seen
        repeats = after(repeats, snapshot(), pose(), YES)
        np.testing.assert_allclose(seen.sigma_px, snapshot().seen.sigma_px, rtol=1e-12)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, 0, None, None))
def learnt(key, repeats_share, turn_rad, exact, start):
    """The share that a drive teaches whose corners have errors of which a share repeats.

    The marker crosses the image at 1 px a frame. The camera is turned by `turn_rad`, and the
    estimate is off by 1 cm and 1 degree.
    """
    lasting_key, *keys = jax.random.split(key, FRAMES + 1)
    turned = jaxlie.SE3.from_rotation(jaxlie.SO3.from_x_radians(turn_rad))
    rig = exact.rig
    slip = jaxlie.SE3.exp(jnp.asarray([0.01, -0.01, 0.0, 0.0, 0.0, np.deg2rad(1.0)]))
    off = jax.vmap(lambda T: (turned @ T).wxyz_xyz)(rig.Ts_camera_vehicle)
    off_rig = dataclasses.replace(rig, Ts_camera_vehicle=jaxlie.SE3(off))

    def frame(carry, key):
        repeats, lasting, index = carry
        T = worlds.planar(0.006 * index - 0.9, -0.4, 1.5)
        corners_px = off_rig.project(T.inverse(), exact.markers.corners_world_m)
        white = jax.random.normal(key, lasting.shape)
        lasting = drifted(lasting, CORRELATION, jax.random.fold_in(key, 1))
        error = jnp.sqrt(1 - repeats_share) * white + jnp.sqrt(repeats_share) * lasting
        corners_px = corners_px + SIGMA_PX * error
        visible = see(rig, exact.markers, T)[1]
        obs = dataclasses.replace(exact.obs, corners_px=corners_px, visible=visible)
        shot = Snapshot.create(rig, exact.markers, obs, SIGMA_PX, 0.0)
        return (LEARNS.after(repeats, shot, T @ slip, YES), lasting, index + 1), None

    lasting = jax.random.normal(lasting_key, exact.obs.corners_px.shape)
    carry, _ = jax.lax.scan(frame, (start, lasting, 0.0), jnp.stack(keys))
    return carry[0].share


def test_the_share_is_learnt_and_white_noise_teaches_none():
    """32 drives each: with white noise of cameras that are 1 degree off, and with errors of which a
    share repeats. Nearly all of white noise's are none, and the share's scatter about the truth."""
    drives = 32
    shares = np.repeat([0.0, 0.2, 0.5], drives)
    turns = np.where(shares == 0, np.deg2rad(1.0), 0)
    keys = jax.vmap(jax.random.key)(jnp.arange(shares.size))
    found = np.asarray(learnt(keys, jnp.asarray(shares), jnp.asarray(turns), snapshot(), nothing()))
    white, some, half = found.reshape(3, drives)
    assert np.mean(white > 0) <= 4 / drives
    assert np.max(white) < 0.02
    assert 0.1 < np.median(some) < 0.25
    assert 0.3 < np.median(half) < 0.55


def test_what_no_pose_explains_is_what_least_squares_leave():
    """As much as NumPy's least squares leave, by numeric derivatives of the marker's pose before
    its camera; and the same axes in the next frame, since its numbers are compared."""
    shot = snapshot()
    rng = np.random.default_rng(3)
    seen = shot.seen
    noisy = seen.corners_px + rng.normal(size=seen.corners_px.shape)
    shot = with_corners(shot, noisy)
    T = pose().inverse()
    got = np.asarray(jax.jit(unexplained)(T, shot))
    for i in np.flatnonzero(np.asarray(seen.visible)):

        @jax.jit
        def residual(xi, i=i):
            T_camera_vehicle = jaxlie.SE3(shot.rig.Ts_camera_vehicle.wxyz_xyz[seen.camera_index[i]])
            corners = shot.markers.corners_world_m[seen.marker_index[i]]
            in_camera = jaxlie.SE3.exp(xi) @ T_camera_vehicle @ T
            camera = jax.tree.map(lambda leaf: leaf[seen.camera_index[i]], shot.rig.cameras)
            pixels = camera.project(jax.vmap(lambda p: in_camera @ p)(corners))
            return ((pixels - noisy[i]) / seen.sigma_px[i][:, None]).reshape(-1)

        r = np.asarray(residual(jnp.zeros(6)))
        J = np.asarray(jax.jit(jax.jacfwd(residual))(jnp.zeros(6)))
        left = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
        np.testing.assert_allclose(np.sum(got[i] ** 2), np.sum(left**2), rtol=1e-9)
    near = np.asarray(jax.jit(unexplained)(T @ jaxlie.SE3.exp(jnp.full(6, 0.01)), shot))
    np.testing.assert_allclose(near, got, atol=0.1 * np.abs(got).max())
    hidden = ~np.asarray(seen.visible)
    assert hidden.any()
    assert (got[hidden] == 0).all()


def test_a_spoilt_frame_teaches_nothing():
    """Corners that are wrong by 30 sigmas once are no proof that errors repeat."""
    repeats, shot = nothing(), snapshot()
    bent = np.array(shot.seen.corners_px)
    bent[:, 0] += 15.0
    for n in range(40):
        wrong = with_corners(shot, jnp.asarray(bent))
        repeats = judged(repeats, wrong if n in (20, 21) else shot, pose())
    assert float(repeats.share) <= 0


@jax.jit
def judged(repeats, shot, T_world_vehicle):
    return LEARNS.after(repeats, shot, T_world_vehicle, YES)


def test_a_pose_that_looks_away_leaves_nothing_behind():
    """A vehicle that was turned round stays decided for some frames: the marker seems behind it.
    White noise after them still teaches nothing."""
    x_m, y_m, psi_rad = worlds.FRONT_VIEW
    here, away = pose(), worlds.planar(x_m, y_m, psi_rad + np.pi)
    repeats, shot, rng = nothing(), snapshot(), np.random.default_rng(1)
    corners_px = np.asarray(shot.seen.corners_px)
    for n in range(200):
        noisy = jnp.asarray(corners_px + SIGMA_PX * rng.normal(size=corners_px.shape))
        repeats = judged(repeats, with_corners(shot, noisy), away if 20 <= n < 30 else here)
    assert float(repeats.share) < 0.02
    assert np.abs(repeats.unexplained).max() < 30


def test_derivatives_are_finite_where_nothing_moves():
    shot, start = snapshot(), nothing()

    def sigma(shift_px, share):
        model = RepeatedErrors(share, share)
        repeats = model.after(start, shot, pose(), YES)
        moved = shoot(shot.rig, shot.markers, shot.obs, shift_px, True)
        return jnp.sum(model.weighed(repeats, moved).seen.sigma_px)

    slopes_of = jax.jit(jax.grad(sigma, argnums=(0, 1)))
    for at in ((0.0, 0.1), (3.0, 0.5)):
        slopes = slopes_of(*map(jnp.asarray, at))
        assert np.all(np.isfinite(slopes))
    assert float(slopes[1]) > 0

    def of_surprise(off):
        belief, none = predicted(off * jnp.ones(3), [0.01] * 3), Candidates.none(2, off.dtype)
        found = dataclasses.replace(none, valid=none.valid.at[0].set(True))
        return surprise_of(belief, jnp.asarray(1), found, shot)

    still, moved = (jax.jit(jax.grad(of_surprise))(jnp.asarray(off)) for off in (0.0, 0.05))
    assert float(still) == 0
    assert np.isfinite(moved)
    assert float(moved) > 0


@in_float32
def test_it_works_in_float32(precision):
    shot = snapshot()
    after = jax.jit(MODEL.after)(nothing(), shot, pose(), YES)
    assert {leaf.dtype for leaf in jax.tree.leaves(after)} == {np.dtype(precision)}
    assert jax.jit(MODEL.weighed)(after, shot).seen.sigma_px.dtype == precision
