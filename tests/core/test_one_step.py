"""The car's compiled program makes the same of events as `step`."""

import operator
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.drive.estimator import Estimator
from jaxnav.drive.history import EventData
from tests import worlds
from tests.helpers.filters import sense, step
from tests.helpers.simulated import make_setup
from tests.reference import paper

# Relative beyond 1; both are 0 as a rule.
TOLERANCES = [("float64", 1e-9), pytest.param("float32", 1e-5, marks=pytest.mark.long)]
PERIOD_US = 66_667
BEGIN_NS = 5_000_000_000
SPEED_MPS, STEERING_RAD, WHEELBASE_M = 0.3, 0.2, 0.256
SIGMA_PX = 1.0
STEPS, TUNNEL, MOVED = 110, range(60, 72), 84  # MOVED: somebody carries the car away
STARTS = np.array([worlds.START_VIEW, worlds.OVERLAP_VIEW])  # before and after that


def poses() -> np.ndarray:
    """(STEPS, 3) x_m, y_m, psi_rad."""
    dt_s = PERIOD_US * 1e-6

    def path(start: np.ndarray, count: int) -> np.ndarray:
        driven = paper.drive(start, SPEED_MPS, STEERING_RAD, count * dt_s, WHEELBASE_M, 20 * count)
        return driven[:-1:20]

    return np.concatenate([path(STARTS[0], MOVED), path(STARTS[1], STEPS - MOVED)])


@pytest.fixture(scope="module")
def seen() -> Observation:
    """A drive, leading axis (STEPS,): two cameras at once, a tunnel, and a place far away."""
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    noise_px = SIGMA_PX * np.random.default_rng(3).standard_normal((STEPS, 4, 1, 4, 2))

    obs = sense(rig, markers, jnp.asarray(poses()), jnp.asarray(noise_px))
    lit = ~np.isin(np.arange(STEPS), TUNNEL)
    dt_s = np.full(STEPS, PERIOD_US) * 1e-6
    dt_s[0] = 0

    def sensed(obs: Observation) -> tuple:
        return obs.visible, obs.speed_mps, obs.steering_rad, obs.dt_s, obs.corner_sigma_px

    return eqx.tree_at(
        sensed,
        jax.device_get(obs),
        (
            np.asarray(obs.visible) & lit[:, None, None],
            np.full(STEPS, SPEED_MPS),
            np.full(STEPS, STEERING_RAD),
            dt_s,
            np.full((STEPS, 4, 1, 4), SIGMA_PX),
        ),
        is_leaf=lambda leaf: leaf is None,
    )


def by_the_car(nav: Navigator, seen: Observation) -> list:
    """What was known after every event, as the loop calls it."""
    estimator, known = Estimator(nav), []
    for index in range(STEPS):
        shown = np.any(seen.visible[index])
        corners = (seen.corners_px[index], seen.visible[index], seen.corner_sigma_px[index])
        told = EventData((SPEED_MPS, STEERING_RAD), *(corners if shown else ()))
        stamp_ns = BEGIN_NS + index * PERIOD_US * 1000
        elapsed_ns = PERIOD_US * 1000 if index else 0
        known.append(estimator.fuse(told, stamp_ns, stamp_ns, elapsed_ns))
    return known


def by_step(nav: Navigator, seen: Observation):
    """(belief, output) after each step."""
    state, known = nav.init(), []
    for index in range(STEPS):
        state, output = step(nav, state, jax.tree.map(operator.itemgetter(index), seen))
        known.append(jax.device_get((state.belief, output)))
    return known


def without_empty_slots(belief, output) -> list[tuple[str, np.ndarray]]:
    """Every leaf by name; what slots without a hypothesis and lanes without a pose hold is 0."""

    def kept(which, tree):
        def of_leaf(leaf):
            return np.where(which.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, np.zeros_like(leaf))

        return jax.tree.map(of_leaf, tree)

    valid = output.candidates.valid
    belief = eqx.tree_at(
        lambda b: b.bank, belief, replace_fn=partial(kept, belief.bank.initialised)
    )
    output = eqx.tree_at(lambda o: (o.candidates, o.costs), output, replace_fn=partial(kept, valid))
    leaves, _ = jax.tree.flatten_with_path((belief, output))
    return [(jax.tree_util.keystr(path), np.asarray(leaf)) for path, leaf in leaves]


def farthest(known: list, stepped: list) -> tuple[float, str]:
    """By how much the two differ at most: absolute, beyond 1 relative."""
    worst = (0.0, "")
    for index, (fused, by_hand) in enumerate(zip(known, stepped, strict=True)):
        one = without_empty_slots(fused.belief, fused.output)
        other = without_empty_slots(*by_hand)
        for (name, a), (_, b) in zip(one, other, strict=True):
            differs = a != b  # infinities too
            gap = np.abs(a[differs].astype(float) - b[differs]) / np.maximum(np.abs(b[differs]), 1)
            worst = max(worst, (float(np.max(gap, initial=0)), f"{name} of event {index}"))
    return worst


@pytest.mark.parametrize(("precision", "tolerance"), TOLERANCES, indirect=["precision"])
def test_the_cars_program_is_step(seen, precision, tolerance):
    """A cold start, two cameras at once, a tunnel without a marker, a restart."""
    seen = jax.tree.map(
        lambda leaf: leaf.astype(precision) if np.issubdtype(leaf.dtype, float) else leaf, seen
    )
    nav = make_setup().navigator()
    known = by_the_car(nav, seen)
    assert known[0].output.pose.dtype == precision
    gap, where = farthest(known, by_step(nav, seen))
    assert gap <= tolerance, where
    # All of that has happened.
    shown, decided = seen.visible[:, :, 0], [bool(one.belief.decided) for one in known]
    assert np.any(shown.sum(axis=1) == 2)
    assert not np.any(shown[TUNNEL])
    assert not decided[0]
    assert decided[TUNNEL[-1]]
    assert known[TUNNEL[-1]].belief.flip_probability == known[TUNNEL[0] - 1].belief.flip_probability
    assert [known[index].belief.restarts for index in (MOVED, -1)] == [0, 1]
