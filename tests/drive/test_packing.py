"""Packing of trees into two vectors, and back."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxnav.drive.packing import Packed, PackedLayout

shapes = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)


@st.composite
def trees(draw):
    """Leaves of all kinds, in any order."""
    kinds = {np.float32: st.floats(width=32), np.int32: st.integers(-5, 5), np.bool_: st.booleans()}
    leaves = []
    for dtype in draw(st.lists(st.sampled_from(list(kinds)), max_size=5)):
        leaves.append(draw(hnp.arrays(dtype, shapes, elements=kinds[dtype])))
    return {"first": leaves[:2], "others": tuple(leaves[2:]), "none": None}


@settings(max_examples=10)
@given(trees())
def test_a_tree_is_found_again_bit_for_bit(tree):
    layout = PackedLayout.from_tree(tree)
    packed = layout.pack(tree)
    assert packed.floats.dtype == np.float32
    assert packed.integers.dtype == np.int32
    written, views = layout.room()
    for view, leaf in zip(jax.tree.leaves(views), jax.tree.leaves(tree), strict=True):
        view[...] = leaf
    for found in (packed.unpack(), packed.fetch().unpack(), written.unpack()):
        assert jax.tree.structure(found) == jax.tree.structure(tree)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(tree), strict=True):
            assert (one.shape, one.dtype) == (other.shape, other.dtype)
            assert np.asarray(one).tobytes() == other.tobytes()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_compiled_call_takes_and_returns_them(dtype):
    """Traced once: layouts of the same shapes are equal, wherever they were made."""
    traces = []

    @jax.jit
    def moved(packed: Packed) -> Packed:
        traces.append(packed)
        T, count = packed.unpack()
        tree = jaxlie.SE3(T.wxyz_xyz.at[4].add(1)), count + 1
        return PackedLayout.from_tree(tree).pack(tree)

    tree = jaxlie.SE3(jnp.array([1, 0, 0, 0, 0, 2, 3], dtype)), jnp.zeros((2, 1), jnp.int32)
    packed = PackedLayout.from_tree(jax.eval_shape(lambda: tree)).pack(tree)
    for _ in range(3):
        packed = moved(packed)
    T, count = packed.fetch().unpack()
    assert T.wxyz_xyz.dtype == dtype
    np.testing.assert_array_equal(T.translation(), [3, 2, 3])
    np.testing.assert_array_equal(count, [[3], [3]])
    assert len(traces) == 1


def test_layouts_differ_where_shapes_types_or_structures_do():
    zeros = np.zeros((2, 3), np.float32)
    trees = [
        (zeros, zeros),
        [zeros, zeros],
        (zeros, zeros.T),
        (zeros, zeros.astype(np.float64)),
        (zeros, zeros > 0),
    ]
    layouts = [PackedLayout.from_tree(tree) for tree in trees]
    assert len(set(layouts)) == len(layouts)
    assert PackedLayout.from_tree((zeros + 1, zeros)) == layouts[0]
