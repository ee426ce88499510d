"""Branches and errors against constructed poses."""

import jax.numpy as jnp
import jaxlie
import pytest

from jaxnav.core.filter.choose import judge_branch, position_error_m
from jaxnav.core.pose.refine import Candidates


def turned(*degrees: float) -> jaxlie.SE3:
    """T_vehicle_world of vehicles turned about z, batch axis as long as the arguments."""
    rotations = [jaxlie.SO3.from_z_radians(jnp.deg2rad(d)).wxyz for d in degrees]
    T_world_vehicle = jaxlie.SE3(
        jnp.stack([jnp.concatenate([q, jnp.array([1.0, 2.0, 0.0])]) for q in rotations])
    )
    return T_world_vehicle.inverse()


def candidates(T_vehicle_world: jaxlie.SE3, valid: list[bool]) -> Candidates:
    n = len(valid)
    return Candidates(
        T_vehicle_world=T_vehicle_world,
        e1_px2=jnp.arange(n, dtype=float),
        cost=jnp.arange(n, dtype=float),
        covariance=jnp.tile(jnp.eye(6), (n, 1, 1)),
        valid=jnp.array(valid),
        converged=jnp.ones(n, bool),
        steps=jnp.zeros(n, int),
    )


TRUTH = jaxlie.SE3(turned(0.0).inverse().wxyz_xyz[0])


@pytest.mark.parametrize(
    ("degrees", "valid", "selected", "expected"),
    [
        # judged, wrong, outlier, ambiguous
        ((1.0, 40.0), [True, True], 0, (True, False, False, True)),
        ((1.0, 40.0), [True, True], 1, (True, True, False, True)),
        ((40.0, 41.0), [True, True], 0, (True, False, True, True)),
        ((40.0, 1.0), [True, False], 0, (True, False, True, False)),
        ((3.0, 1.0), [True, False], 0, (True, False, False, False)),
        # Equally far, but for rounding.
        ((-7.0, 7.0), [True, True], 0, (True, False, False, True)),
        ((-7.0, 7.0), [True, True], 1, (True, False, False, True)),
        ((1.0, 40.0), [True, True], -1, (False, False, False, False)),
        ((1.0, 40.0), [False, False], -1, (False, False, False, False)),
    ],
)
def test_a_branch_is_wrong_when_another_candidate_is_closer_in_angle(
    degrees, valid, selected, expected
):
    branch = judge_branch(candidates(turned(*degrees), valid), jnp.asarray(selected), TRUTH)
    assert (
        bool(branch.judged),
        bool(branch.wrong),
        bool(branch.outlier),
        bool(branch.ambiguous),
    ) == expected


def test_a_distance_is_that_of_the_positions():
    T_a_b, T_a_c = (
        jaxlie.SE3.from_rotation_and_translation(
            jaxlie.SO3.from_x_radians(angle), jnp.array([1.0, 2.0, z])
        )
        for angle, z in ((0.3, 3.0), (-0.4, 5.0))
    )
    assert position_error_m(T_a_b, T_a_c) == pytest.approx(2.0)
