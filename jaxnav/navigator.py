"""Algorithm 1: from corners, odometry and a route to a command. Read this first.

Source: Liu, Schofield, Shan (2023), Algorithm 1.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.belief.ambiguity import Selector
from jaxnav.belief.bicycle_kalman import BicycleKalman
from jaxnav.belief.constant_velocity import ConstantVelocity
from jaxnav.belief.hypotheses import MultiHypothesis
from jaxnav.belief.motion import (
    Belief,
    Motion,
    followed_by,
    leading,
    numbered_anew_where_empty,
    of_mixture,
    restarted_where_broken,
    survivors_first,
)
from jaxnav.control import Command, Controller, ControlLog, ControlState
from jaxnav.models.bicycle import Vehicle
from jaxnav.models.geometry import planar_from_T_world_vehicle, transform_points
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig
from jaxnav.pose.candidates import Candidates, find_candidates
from jaxnav.pose.observation import MODEL_SIGMA_PX, Observation, Snapshot, slots

# Slots of the banks that `step_by_regime` keeps compiled beside the whole one: nine frames of ten
# need a single one, and of the others two of three no more than these.
_BANKS = (1, 8)


class State(eqx.Module):
    """Everything `step` carries from one observation to the next."""

    belief: Belief
    control: ControlState | None  # None without a route


class Output(eqx.Module):
    """Everything `step` knows after one observation."""

    pose: Float[Array, " 3"]  # x_m, y_m, psi_rad in the world
    covariance: Float[Array, "d d"]  # of the state's error: (6, 6) for a car, see the motion model
    T_world_vehicle: jaxlie.SE3
    located: Bool[Array, ""]  # False until the first pose was taken
    command: Command | None
    done: Bool[Array, ""]  # the last waypoint is reached
    candidates: Candidates
    costs: Float[Array, " N"]  # of the candidates, in the selector's unit
    selected: Int[Array, ""]  # the candidate taken, -1: none
    hypothesis: Int[Array, ""]  # the one reported; while it survives, it keeps its number
    flip_probability: Float[Array, ""]  # probability that the reported pose is the wrong one
    decided: Bool[Array, ""]  # False: several poses are still possible, and none is acted upon
    nis: Float[Array, ""]  # of the pose taken, 0 where none was
    control_log: ControlLog | None


class Believed(eqx.Module):
    """What is reported of a belief: its heaviest hypothesis."""

    mean: Float[Array, " n"]  # as the motion model stores it
    T_world_vehicle: jaxlie.SE3
    covariance: Float[Array, "d d"]
    located: Bool[Array, ""]
    hypothesis: Int[Array, ""]


class Estimate(eqx.Module):
    """The belief after an observation, and what is reported of it; see `Output`."""

    belief: Belief
    best: Believed
    costs: Float[Array, " N"]
    selected: Int[Array, ""]
    flip_probability: Float[Array, ""]
    decided: Bool[Array, ""]
    nis: Float[Array, ""]
    restarted: Bool[Array, ""]  # all that was believed was contradicted too often: started anew
    # Of the corners given what the whole bank had predicted, up to a constant; 0 at a start.
    log_likelihood: Float[Array, ""]


class Navigator(eqx.Module):
    """A rig that finds its way by markers. Immutable; `init` and `step` are pure.

    With a vehicle and waypoints it drives; without, it only localises (give it the motion model
    of the body then, `ConstantVelocity()` by default).

    Waypoints, states and outputs count from `markers.origin_m`, zero unless the map is far from it:
    `Route.relative_to` leads there, `planar_in_world` and `poses_in_world` lead back.
    """

    rig: CameraRig
    markers: MarkerMap
    selector: Selector
    motion: Motion
    controller: Controller | None
    corner_sigma_px: Float[Array, ""]
    model_sigma_px: Float[Array, ""]
    max_sightings: int | None = eqx.field(static=True)
    max_candidates: int = eqx.field(static=True)
    max_lm_steps: int = eqx.field(static=True)
    ground_plane: bool = eqx.field(static=True)

    def __init__(
        self,
        rig: CameraRig,
        markers: MarkerMap,
        vehicle: Vehicle | None = None,
        waypoints_m: Sequence[Sequence[float]] | Float[Array, "W 2"] = (),
        waypoint_radius_m: float = 0.15,
        selector: Selector | None = None,
        motion: Motion | None = None,
        proportional_per_m: float = 0.03,
        integral_per_ms: float = 0.005,
        integral_limit_ms: float = 5.0,
        corner_sigma_px: float = 1.0,
        model_sigma_px: float = MODEL_SIGMA_PX,
        max_sightings: int | None = None,
        max_candidates: int = 4,
        max_lm_steps: int = 12,
        ground_plane: bool = False,
    ):
        """See the fields of `Controller`, `Snapshot`, `find_candidates` and the motion models.

        Raises:
            ValueError: waypoints without a vehicle, or of the wrong shape.
        """
        self.rig = rig
        self.markers = markers
        self.selector = selector or MultiHypothesis()
        if motion is None:
            motion = ConstantVelocity() if vehicle is None else BicycleKalman(vehicle)
        self.motion = motion
        self.controller = None
        if len(waypoints_m) > 0:
            waypoints = jnp.asarray(waypoints_m, float)
            if vehicle is None:
                raise ValueError("waypoints_m needs a vehicle to drive")
            if waypoints.ndim != 2 or waypoints.shape[1] != 2:
                raise ValueError(f"waypoints_m must be (W, 2), got {waypoints.shape}")
            self.controller = Controller(
                waypoints_m=waypoints,
                waypoint_radius_m=jnp.asarray(waypoint_radius_m, float),
                vehicle=vehicle,
                proportional_per_m=jnp.asarray(proportional_per_m, float),
                integral_per_ms=jnp.asarray(integral_per_ms, float),
                integral_limit_ms=jnp.asarray(integral_limit_ms, float),
            )
        self.corner_sigma_px = jnp.asarray(corner_sigma_px, float)
        self.model_sigma_px = jnp.asarray(model_sigma_px, float)
        self.max_sightings = max_sightings
        self.max_candidates = max_candidates
        self.max_lm_steps = max_lm_steps
        self.ground_plane = ground_plane

    def init(self) -> State:
        """Nothing seen yet, at the first waypoint."""
        control = None if self.controller is None else self.controller.init()
        return State(self.motion.init(self.selector.hypotheses), control)

    def step(self, state: State, obs: Observation) -> tuple[State, Output]:
        """One pass of Algorithm 1."""
        obs = obs.usable()
        snapshot = self.snapshot(obs)
        candidates = self.find_candidates(snapshot)
        estimate = self.estimate(state.belief, snapshot, candidates)
        return self._acted(state, obs, candidates, estimate)

    def coast(self, belief: Belief, obs: Observation) -> Belief:
        """The belief at an observation without a marker: prediction and odometry alone."""
        start = self.motion.init(belief.initialised.shape[0])
        return restarted_where_broken(self.motion.predict(belief, obs), start)

    def step_by_regime(self, state: State, obs: Observation) -> tuple[State, Output]:
        """`step` without the slots that are empty: the same up to rounding.

        Branches for one sighting or several, and for one hypothesis, a few or the whole bank: worth
        it where many lanes run side by side, each in its own branch (see `lanes`).
        """
        obs = obs.usable()
        snapshot = self.snapshot(obs)
        candidates = self._candidates_by_regime(snapshot)
        belief, count = state.belief, state.belief.initialised.shape[0]
        if count == 1 or not isinstance(self.selector, MultiHypothesis):
            estimate = self.estimate(belief, snapshot, candidates)
            return self._acted(state, obs, candidates, estimate)
        starts = jnp.any(snapshot.seen.visible) & ~jnp.any(
            belief.initialised & ~self.motion.lost(belief)
        )
        empty = self.motion.init(count)

        def within(size: int) -> Callable[[Belief], Estimate]:
            def estimate(belief: Belief) -> Estimate:
                found = self.estimate(leading(belief, size), snapshot, candidates)
                bank = followed_by(survivors_first(found.belief), empty)
                return eqx.tree_at(lambda e: e.belief, found, bank)

            return estimate

        sizes = [size for size in _BANKS if size < count] + [count]
        needed = jnp.max(jnp.where(belief.initialised, jnp.arange(count) + 1, 0))
        needed = jnp.where(starts, count, needed)
        index = jnp.sum(needed > jnp.asarray(sizes[:-1]))
        estimate = jax.lax.switch(index, [within(size) for size in sizes], belief)
        return self._acted(state, obs, candidates, estimate)

    def _candidates_by_regime(self, snapshot: Snapshot) -> Candidates:
        visible = snapshot.seen.visible
        count = min(self.max_candidates, 2 * visible.shape[0])
        if visible.shape[0] == 1:
            return self.find_candidates(snapshot)
        return jax.lax.cond(
            jnp.any(visible[1:]),
            self.find_candidates,
            lambda snapshot: self.find_candidates(snapshot.largest(1)).padded(count),
            snapshot,
        )

    def estimate(self, belief: Belief, snapshot: Snapshot, candidates: Candidates) -> Estimate:
        """The belief after an observation: predicted, held against the corners, corrected."""
        obs = snapshot.obs
        before, start = belief, self.motion.init(belief.initialised.shape[0])
        prior = numbered_anew_where_empty(self.motion.predict(belief, obs))
        selection = self.selector(self.motion.poses(prior), candidates, snapshot)
        belief, nis, log_likelihood = self.motion.update(prior, selection, obs)
        belief = restarted_where_broken(belief, start)

        best = self._best(belief)
        return Estimate(
            belief=belief,
            best=self._believed(belief, best),
            costs=selection.costs,
            selected=selection.selected,
            flip_probability=selection.flip_probability,
            decided=selection.decided,
            nis=jnp.where(belief.initialised[best], nis[best], 0),
            log_likelihood=of_mixture(prior, log_likelihood),
            restarted=jnp.any(before.initialised) & ~jnp.any(prior.initialised),
        )

    def believed(self, belief: Belief) -> Believed:
        """The heaviest hypothesis, its covariance that of the whole bank about it."""
        return self._believed(belief, self._best(belief))

    def _best(self, belief: Belief) -> Int[Array, ""]:
        return jnp.argmax(jnp.where(belief.initialised, belief.log_weight, -jnp.inf))

    def _believed(self, belief: Belief, best: Int[Array, ""]) -> Believed:
        return Believed(
            mean=belief.mean[best],
            T_world_vehicle=jax.tree.map(
                lambda leaf: leaf[best], self.motion.poses(belief).T_world_vehicle
            ),
            covariance=self.motion.error_covariance(belief, best),
            located=belief.initialised[best],
            hypothesis=belief.number[best],
        )

    def _acted(
        self, state: State, obs: Observation, candidates: Candidates, estimate: Estimate
    ) -> tuple[State, Output]:
        control, output = self.act(state.control, obs, candidates, estimate)
        return State(estimate.belief, control), output

    def act(
        self,
        control: ControlState | None,
        obs: Observation,
        candidates: Candidates,
        estimate: Estimate,
    ) -> tuple[ControlState | None, Output]:
        """What to do at the pose that is believed, and all that is reported."""
        best = estimate.best
        pose = planar_from_T_world_vehicle(best.T_world_vehicle)
        control, command, done, log = self._steer(
            control, pose, best.T_world_vehicle, best.located, estimate.decided, obs
        )
        return control, Output(
            pose=pose,
            covariance=best.covariance,
            T_world_vehicle=best.T_world_vehicle,
            located=best.located,
            command=command,
            done=done,
            candidates=candidates,
            costs=estimate.costs,
            selected=estimate.selected,
            hypothesis=best.hypothesis,
            flip_probability=estimate.flip_probability,
            decided=estimate.decided,
            nis=estimate.nis,
            control_log=log,
        )

    def snapshot(self, obs: Observation) -> Snapshot:
        """The observation, together with rig and map."""
        return Snapshot.create(
            self.rig,
            self.markers,
            obs,
            self.corner_sigma_px,
            self.model_sigma_px,
            self.max_sightings,
        )

    def find_candidates(self, snapshot: Snapshot) -> Candidates:
        """Both poses of every marker in view, refined."""
        return find_candidates(snapshot, self.max_candidates, self.max_lm_steps, self.ground_plane)

    def no_candidates(self) -> Candidates:
        """What `find_candidates` returns where nothing is in view."""
        count = min(self.max_candidates, 2 * slots(self.rig, self.markers, self.max_sightings))
        return Candidates.none(count, self.rig.cameras.focal_px.dtype)

    def _steer(
        self,
        state: ControlState | None,
        pose: Array,
        T_world_vehicle: jaxlie.SE3,
        located: Array,
        decided: Array,
        obs: Observation,
    ) -> tuple[ControlState | None, Command | None, Array, ControlLog | None]:
        if self.controller is None or state is None:
            return None, None, jnp.asarray(False), None
        centers_m = transform_points(
            T_world_vehicle.inverse(), self.markers.Ts_world_marker.translation()
        )[:, :2]
        nearest_m = centers_m[jnp.argmin(jnp.sum(centers_m**2, axis=1))]
        speed_mps = jnp.where(obs.has_odometry, obs.speed_mps, jnp.nan)
        steering_rad, dt_s, speed_mps = (
            jnp.asarray(x, pose.dtype) for x in (obs.steering_rad, obs.dt_s, speed_mps)
        )
        return self.controller(
            state, pose, located, steering_rad, dt_s, decided, nearest_m, speed_mps
        )

    # Bound methods hash their owner: by identity, so that `jax.jit(navigator.step)` works.
    __hash__ = object.__hash__


Step = Callable[[State, Observation], tuple[State, Output]]


@jax.jit
def jitted_step(navigator: Navigator, state: State, obs: Observation) -> tuple[State, Output]:
    """`navigator.step`, one program for all navigators of a structure."""
    return navigator.step(state, obs)
