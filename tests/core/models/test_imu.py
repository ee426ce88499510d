"""Preintegration against GTSAM, a textbook in NumPy, and the derivatives of a smooth trajectory."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.core.models.imu import (
    CONSUMER,
    GYROS,
    PRESETS,
    TACTICAL,
    ImuNoise,
    ImuSamples,
    Preintegrated,
    Readings,
    preintegrate,
    right_jacobian,
)
from tests.derivatives import in_float32

NOISE = ImuNoise(2e-3, 3e-2, 4e-3, 5e-2, 0.05, 0.2)
run = eqx.filter_jit(preintegrate)


def readings(gyro, accel, dt_s, still=False) -> Readings:
    count = len(gyro)
    dt = jnp.broadcast_to(jnp.asarray(dt_s, float), (count,))
    numbers = jnp.asarray(gyro, float), jnp.asarray(accel, float), dt
    return Readings(*numbers, jnp.zeros(count, bool), jnp.asarray(still))


def random_readings(count=20, seed=0):
    rng = np.random.default_rng(seed)
    gyro = rng.normal(size=(count, 3)) * 3
    return gyro, rng.normal(size=(count, 3)) * 5 + [0, 0, 9.8]


def textbook(gyro, accel, dt_s, gyro_bias=0.0, accel_bias=0.0):
    """dR, dv, dp: the sums of Forster et al. (2017), Eq. 33 without noise, written out."""
    Rs = [np.eye(3)]
    for w in gyro - gyro_bias:
        Rs.append(Rs[-1] @ Rotation.from_rotvec(w * dt_s).as_matrix())
    a = np.einsum("nij,nj->ni", Rs[:-1], accel - accel_bias)
    v = np.vstack([np.zeros(3), np.cumsum(a * dt_s, axis=0)])
    p = np.sum(v[:-1] * dt_s + a * dt_s**2 / 2, axis=0)
    return Rs[-1], v[-1], p


def error(measured, reference) -> np.ndarray:
    """(9,) from one (R, v, p) to another, the rotation on the right."""
    turn = Rotation.from_matrix(reference[0].T @ measured[0]).as_rotvec()
    return np.concatenate([turn, measured[1] - reference[1], measured[2] - reference[2]])


def parts(result: Preintegrated):
    R = Rotation.from_quat(np.roll(result.R_begin_end.wxyz, -1)).as_matrix()
    return R, np.asarray(result.velocity_mps), np.asarray(result.position_m)


def test_the_increments_are_the_textbook_s():
    gyro, accel = random_readings()
    b_gyro, b_accel = jnp.asarray([0.1, -0.2, 0.05]), jnp.asarray([0.3, 0.1, -0.4])
    result = run(readings(gyro, accel, 0.01), NOISE, b_gyro, b_accel)
    expected = textbook(gyro, accel, 0.01, np.asarray(b_gyro), np.asarray(b_accel))
    np.testing.assert_allclose(error(parts(result), expected), 0, atol=1e-12)
    assert result.duration_s == pytest.approx(0.2)


def test_bias_jacobians_and_covariance_are_those_of_differences():
    """Each reading, and each bias, moved by a little in the textbook's sums."""
    (gyro, accel), dt_s, h = random_readings(12), 0.02, 1e-6
    result = run(readings(gyro, accel, dt_s), NOISE)
    base = textbook(gyro, accel, dt_s)

    def slope(moved):
        return (error(moved(h), base) - error(moved(-h), base)) / (2 * h)

    eye = np.eye(3)
    by_gyro = [slope(lambda s, e=e: textbook(gyro, accel, dt_s, s * e)) for e in eye]
    by_accel = [slope(lambda s, e=e: textbook(gyro, accel, dt_s, 0.0, s * e)) for e in eye]
    by_bias = np.column_stack(by_gyro + by_accel)
    np.testing.assert_allclose(result.by_bias, by_bias, rtol=1e-6, atol=1e-8)

    # Noise of row i, then the walk up to row i, which every later row has as its bias.
    covariance = np.zeros((15, 15))
    densities = np.asarray(NOISE.densities()).reshape(4, 3)[:, 0]
    for i in range(len(gyro)):
        after = np.arange(len(gyro))[:, None] > i
        at = np.arange(len(gyro))[:, None] == i
        for axis in eye:
            columns = (
                slope(lambda s, m=at * axis: textbook(gyro + s * m, accel, dt_s)),
                slope(lambda s, m=at * axis: textbook(gyro, accel + s * m, dt_s)),
                slope(lambda s, m=after * axis: textbook(gyro - s * m, accel, dt_s)),
                slope(lambda s, m=after * axis: textbook(gyro, accel - s * m, dt_s)),
            )
            ends = np.zeros(3), np.zeros(3)
            of_bias = ((*ends,), (*ends,), (axis, np.zeros(3)), (np.zeros(3), axis))
            times = (1 / dt_s, 1 / dt_s, dt_s, dt_s)
            for column, bias, density, time in zip(columns, of_bias, densities, times, strict=True):
                whole = np.concatenate([column, *bias])
                covariance += density * time * np.outer(whole, whole)
    scale = np.sqrt(np.diag(covariance))
    ours = np.asarray(result.covariance)
    np.testing.assert_allclose(ours / scale / scale[:, None], covariance / scale / scale[:, None],
                               atol=2e-6)  # fmt: skip


def gtsam_of(gtsam, gyro, accel, dt_s, noise=NOISE, biases=(0.0, 0.0), combined=False):
    """GTSAM's preintegration of the readings, without noise of the integration.

    Args:
        biases: of accelerometer and gyroscope, with which it is preintegrated.
        combined: whether the biases walk.
    """
    if combined:
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
        params.setBiasAccCovariance(np.eye(3) * noise.accelerometer_random_walk**2)
        params.setBiasOmegaCovariance(np.eye(3) * noise.gyroscope_random_walk**2)
        params.setBiasAccOmegaInit(np.zeros((6, 6)))
    else:
        params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(np.eye(3) * noise.gyroscope_noise_density**2)
    params.setAccelerometerCovariance(np.eye(3) * noise.accelerometer_noise_density**2)
    params.setIntegrationCovariance(np.zeros((3, 3)))
    kind = "PreintegratedCombinedMeasurements" if combined else "PreintegratedImuMeasurements"
    bias = gtsam.imuBias.ConstantBias(*(np.broadcast_to(b, 3) for b in biases))
    measured = getattr(gtsam, kind)(params, bias)
    for w, a in zip(gyro, accel, strict=True):
        measured.integrateMeasurement(a, w, dt_s)
    return measured


def of_gtsam(measured):
    return measured.deltaRij().matrix(), measured.deltaVij(), measured.deltaPij()


def in_our_order(covariance, turn, biases=False):
    """GTSAM's (rotation vector, p, v, accelerometer's bias, gyroscope's) as ours.

    Between increments and walks GTSAM 4.3 has the other sign; differences, above, tell which.
    """
    J = np.diag(np.r_[np.ones(9), -np.ones(6)][: len(covariance)])
    J[:3, :3] = jax.jit(right_jacobian)(jnp.asarray(turn))
    order = np.r_[0:3, 6:9, 3:6, 12:15, 9:12] if biases else np.r_[0:3, 6:9, 3:6]
    return (J @ covariance @ J.T)[np.ix_(order, order)]


def need_gtsam():
    return pytest.importorskip("gtsam", reason="gtsam, the oracle, has no wheel here")


def test_gtsam_s_increments_covariance_and_walks_are_the_limit_of_ours():
    """Elsewhere the two differ by the order of the step: rows in 16 parts agree 16 times."""
    gtsam, (gyro, accel) = need_gtsam(), random_readings(12, seed=3)
    gaps = []
    for parts_of_row in (1, 16, 256):
        w, a = (np.repeat(rows, parts_of_row, axis=0) for rows in (gyro, accel))
        dt_s = 0.02 / parts_of_row
        result = run(readings(w, a, dt_s), NOISE)
        measured = gtsam_of(gtsam, w, a, dt_s, combined=True)
        turn = Rotation.from_matrix(measured.deltaRij().matrix()).as_rotvec()
        theirs = in_our_order(measured.preintMeasCov(), turn, biases=True)
        scale = np.sqrt(np.diag(theirs))
        gap = np.abs(np.asarray(result.covariance) - theirs) / scale / scale[:, None]
        gaps.append((np.max(np.abs(error(parts(result), of_gtsam(measured)))), np.max(gap)))
    (increments, covariances) = np.array(gaps).T
    assert increments[0] > 1e-5
    for each in (increments, covariances):
        np.testing.assert_array_less(each[1:], each[:-1] / 12)
    assert increments[2] < 1e-5
    assert covariances[2] < 5e-4


def smooth(times_s):
    """R (n, 3, 3), p, w and specific force of a body that swings, by differences of 1e-4 s."""

    def pose(t):
        angles = np.stack([0.8 * np.sin(2 * t), 0.5 * np.sin(3.1 * t + 1), 2.5 * t], axis=-1)
        p = np.stack([0.5 * np.sin(2.2 * t), 0.3 * np.cos(2.9 * t), 0.2 * np.sin(4 * t)], axis=-1)
        return Rotation.from_euler("xyz", angles), p

    h = 1e-4
    (R, p), (R_after, after), (R_before, before) = (
        pose(times_s),
        pose(times_s + h),
        pose(times_s - h),
    )
    w = (R_before.inv() * R_after).as_rotvec() / (2 * h)
    a = (after - 2 * p + before) / h**2
    return (
        R.as_matrix(),
        p,
        (after - before) / (2 * h),
        w,
        R.inv().apply(a + np.array([0, 0, 9.81])),
    )


def samples(rate_hz=200.0, end_s=1.1, noise=NOISE, **options) -> ImuSamples:
    times_s = np.arange(0, end_s, 1 / rate_hz)
    *_, gyro, accel = smooth(times_s)
    T = options.pop("T_vehicle_imu", np.eye(4))
    return ImuSamples(np.round(times_s * 1e9).astype(np.int64), gyro, accel, T, noise, **options)


STAMPS_NS = np.array([0.1033, 0.1402, 0.5021, 1.0013]) * 1e9


def true_increments(stamps_ns=STAMPS_NS):
    """(R, v, p) of each interval by the trajectory itself, in the axes of its beginning."""
    R, p, v, *_ = smooth(np.asarray(stamps_ns) / 1e9)
    found = []
    for i in range(1, len(R)):
        T, g = (stamps_ns[i] - stamps_ns[i - 1]) / 1e9, np.array([0, 0, -9.81])
        dv = R[i - 1].T @ (v[i] - v[i - 1] - g * T)
        dp = R[i - 1].T @ (p[i] - p[i - 1] - v[i - 1] * T - g * T**2 / 2)
        found.append((R[i - 1].T @ R[i], dv, dp))
    return found


def one_of(result: Preintegrated, index: int) -> Preintegrated:
    return jax.tree.map(lambda leaf: leaf[index], result)


@pytest.mark.parametrize(
    ("rate_hz", "tolerance"), [(200.0, 5e-4), pytest.param(800.0, 4e-5, marks=pytest.mark.long)]
)
def test_samples_of_a_trajectory_give_its_own_increments(rate_hz, tolerance):
    """Of intervals that begin and end between samples; 16 times as exact at 4 times the rate."""
    result = samples(rate_hz).between(STAMPS_NS.astype(np.int64))
    assert not result.duration_s[0]
    for index, expected in enumerate(true_increments(), 1):
        np.testing.assert_allclose(error(parts(one_of(result, index)), expected), 0, atol=tolerance)
    np.testing.assert_allclose(result.duration_s[1:], np.diff(STAMPS_NS) / 1e9, rtol=1e-9)


def test_an_imu_that_lies_askew_and_is_late_tells_the_same():
    stamps_ns = STAMPS_NS.astype(np.int64)
    plain = samples()
    R = Rotation.from_euler("xyz", [0.3, -2.0, 1.1]).as_matrix()
    T = np.eye(4)
    T[:3, :3] = R
    turned = dataclasses.replace(
        plain,
        stamps_ns=plain.stamps_ns + 10_000_000,
        gyro_radps=plain.gyro_radps @ R,
        accel_mps2=plain.accel_mps2 @ R,
        T_vehicle_imu=T,
        delay_s=0.01,
    )
    for ours, expected in zip(
        jax.tree.leaves(turned.between(stamps_ns)),
        jax.tree.leaves(plain.between(stamps_ns)),
        strict=True,
    ):
        np.testing.assert_allclose(ours, expected, atol=1e-9)


@pytest.mark.parametrize("damage", ["nan", "saturated", "missing"])
def test_what_a_sensor_could_not_read_is_bridged_and_counts_for_less(damage):
    """60 ms of nonsense: the truth stays within three sigmas, ten times as wide as before."""
    whole = samples(max_gyro_radps=50.0, max_accel_mps2=160.0)
    at = slice(60, 72)
    gyro, accel, stamps_ns = (
        x.copy() for x in (whole.gyro_radps, whole.accel_mps2, whole.stamps_ns)
    )
    if damage == "nan":
        accel[at, 1] = np.nan
    elif damage == "saturated":
        gyro[at, 2] = 50.0
    kept = np.ones(len(gyro), bool)
    if damage == "missing":
        kept[at] = False
    hurt = dataclasses.replace(
        whole, stamps_ns=stamps_ns[kept], gyro_radps=gyro[kept], accel_mps2=accel[kept]
    )
    stamps_ns = STAMPS_NS.astype(np.int64)
    before, after = whole.between(stamps_ns), hurt.between(stamps_ns)
    for index in (1, 3):
        np.testing.assert_array_equal(before.covariance[index], after.covariance[index])
    P = after.covariance[2][:9, :9]
    assert np.all(np.diag(P) > 100 * np.diag(before.covariance[2])[:9])
    off = error(parts(one_of(after, 2)), true_increments()[1])
    assert np.all(np.abs(off) < 3 * np.sqrt(np.diag(P)))


def test_a_long_hole_is_no_reading():
    whole = samples(end_s=2.1)
    stamps_ns = np.array([0.1, 0.2, 1.0, 1.1, 2.05, 2.4]) * 1e9
    kept = (whole.stamps_ns < 3e8) | (whole.stamps_ns > 8e8)
    hurt = dataclasses.replace(
        whole,
        stamps_ns=whole.stamps_ns[kept],
        gyro_radps=whole.gyro_radps[kept],
        accel_mps2=whole.accel_mps2[kept],
    )
    told = hurt.between(stamps_ns.astype(np.int64)).duration_s > 0
    np.testing.assert_array_equal(told, [False, True, False, True, True, False])


def test_the_first_order_correction_is_that_of_integrating_anew():
    gyro, accel = random_readings(30, seed=5)
    rows = readings(gyro, accel, 0.01)
    result = run(rows, NOISE)
    gaps = []
    for size in (1.0, 0.1):
        biases = size * jnp.asarray([0.02, -0.03, 0.01]), size * jnp.asarray([0.2, -0.1, 0.3])
        R, v, p = eqx.filter_jit(Preintegrated.at_biases)(result, *biases)
        R = Rotation.from_quat(np.roll(R.wxyz, -1)).as_matrix()
        corrected = R, np.asarray(v), np.asarray(p)
        anew = parts(run(rows, NOISE, *biases))
        gaps.append(np.max(np.abs(error(corrected, anew))))
        assert np.max(np.abs(error(corrected, parts(result)))) > 100 * gaps[-1]
    assert gaps[1] < gaps[0] / 50


def test_padding_changes_nothing():
    gyro, accel = random_readings(10)
    plain = run(readings(gyro, accel, 0.01), NOISE)
    more = np.vstack([gyro, np.ones((6, 3))]), np.vstack([accel, np.ones((6, 3))])
    padded = run(readings(*more, np.r_[np.full(10, 0.01), np.zeros(6)]), NOISE)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(padded), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


@pytest.mark.parametrize("moving", [0.0, 0.05], ids=["at rest", "by a hand"])
def test_rest_is_told_from_a_hand_that_trembles(moving):
    rng = np.random.default_rng(0)
    times_s = np.arange(0, 2, 1 / 200)
    sigma = np.sqrt(np.asarray(CONSUMER.densities())[[0, 3]] * 200)
    swing = moving * np.sin(2 * np.pi * 3 * times_s)[:, None]
    gyro = 0.02 + sigma[0] * rng.normal(size=(400, 3)) + swing
    accel = [0, 0, 9.81] + sigma[1] * rng.normal(size=(400, 3)) + 5 * swing
    track = ImuSamples(np.round(times_s * 1e9).astype(np.int64), gyro, accel, np.eye(4), CONSUMER)
    still = track.between(np.array([3, 9, 19]) * 10**8).still
    np.testing.assert_array_equal(still, [False, not moving, not moving])


def test_a_datasheet_is_in_si():
    assert TACTICAL.gyroscope_noise_density < CONSUMER.gyroscope_noise_density
    assert set(PRESETS) == {"consumer", "tactical"}
    # A second of white noise of the gyroscope: 0.014 degrees; of the accelerometer: 175e-6 g s.
    still = run(readings(np.zeros((100, 3)), np.zeros((100, 3)), 0.01), CONSUMER)
    walks = CONSUMER.gyroscope_random_walk, CONSUMER.accelerometer_random_walk
    whites = np.deg2rad(0.014), 175e-6 * 9.80665
    for row, walk, white in zip((0, 3), walks, whites, strict=True):
        expected = white**2 + walk**2 * 0.99 * 0.985 / 3
        assert still.covariance[row, row] == pytest.approx(expected, rel=0.02)
    for name, noise in PRESETS.items():  # one table for the gyro of a base and for an IMU
        gyro = GYROS[name]
        assert noise.gyroscope_noise_density == gyro.noise_density
        assert noise.gyroscope_bias_sigma == gyro.bias_sigma_radps
        assert noise.gyroscope_random_walk == gyro.bias_walk


@in_float32
def test_gradients_are_finite_at_rest_and_without_a_reading(precision):
    def total(floats, dt_s):
        gyro, accel = floats
        result = preintegrate(readings(gyro, accel, dt_s), NOISE).usable()
        R, v, p = result.at_biases(gyro[0], accel[0])
        numbers = R.wxyz, v, p, result.covariance, result.by_bias
        return sum(jnp.sum(x) for x in numbers)

    zero = jnp.zeros((4, 3))
    slope = jax.jit(jax.grad(total, argnums=(0, 1)))
    for dt_s in (jnp.full(4, 0.01, float), jnp.zeros(4), jnp.full(4, jnp.nan, float)):
        for leaf in jax.tree.leaves(slope((zero, zero), dt_s)):
            assert leaf.dtype == precision
            assert np.all(np.isfinite(leaf)) or np.isnan(dt_s[0])
