"""The suite's import hook refuses arrays, and in the core classes, that annotations don't allow."""

from types import SimpleNamespace

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from jaxnav.core.linalg.small_matrices import cholesky, log_det
from jaxnav.core.models.geometry import wrap_angle
from jaxnav.core.navigator import Navigator
from jaxnav.sim.plant import CarState, move
from tests import worlds


def test_the_core_refuses_a_shape():
    with pytest.raises(TypeCheckError, match="A"):
        cholesky(jnp.zeros((2, 3)))


def test_the_core_refuses_a_dtype():
    with pytest.raises(TypeCheckError, match="L"):
        log_det(jnp.zeros((2, 2), int))


def test_the_core_refuses_another_class_where_no_array_is_named():
    nav = Navigator(worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar())
    with pytest.raises(Exception, match="obs"):
        nav.look(1.0)


def test_around_the_core_a_shape_is_refused_and_a_stand_in_is_not():
    car, still = worlds.qcar(), CarState(jnp.zeros(3), jnp.asarray(0.0), jnp.asarray(0.0))
    command = SimpleNamespace(steering_rad=0.0, throttle=0.1)
    assert move(car, still, command, jnp.asarray(0.1)).speed_mps > 0
    with pytest.raises(TypeCheckError, match="dt_s"):
        move(car, still, command, jnp.zeros(2))


def test_what_annotations_allow_is_taken():
    assert wrap_angle(jnp.asarray(0.5)) == 0.5
    assert cholesky(jnp.eye(3)).shape == (3, 3)
