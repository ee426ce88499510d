"""Algorithm 1: from corners, odometry and a route to a command. Read this first.

The way of the data and the decisions behind it are in docs/design.md.

Source: Liu, Schofield, Shan (2023), Algorithm 1.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.core.control import ControlInput, ControlLog, ControlState, Follower, follower_along
from jaxnav.core.filter.bank import Bank, heaviest, renumber_if_empty
from jaxnav.core.filter.choose import Selector, Ungated
from jaxnav.core.filter.errors import RepeatedErrors, surprise_of
from jaxnav.core.filter.estimate import Belief, Estimate, Evidence
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.motion import Motion
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.filter.smooth import Lagged, Window
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.pose.candidates import ConsistentSnapshot, find_candidates, remove_outliers
from jaxnav.core.pose.observation import MODEL_SIGMA_PX, Observation, Snapshot, slots
from jaxnav.core.pose.refine import Candidates


class State(eqx.Module):
    """The state that `step` carries from one observation to the next."""

    belief: Belief
    control: ControlState | None  # None without a route
    window: Window | None = None  # None without a lag


class Output(Estimate):
    """The estimate after one observation, with the command that follows from it."""

    command: Any  # `Command` of a car, `TwistCommand` of another base; None without a route
    done: Bool[Array, ""]  # the last waypoint is reached
    control_log: ControlLog | None
    lagged: Lagged | None = None  # the smoothed pose of `lag_s` ago; None without a lag


class Navigator(eqx.Module):
    """Algorithm 1 for one rig in one map of markers. Immutable; `init` and `step` are pure.

        state = navigator.init()
        state, output = navigator.step(state, obs)

    With a vehicle and waypoints it commands the vehicle, a car by steering and throttle, a
    `TwistBase` by a twist; the gains of the throttle are a car's. Without them it only localises,
    with the motion model of the body, `ConstantVelocity()` by default. Coordinates count from
    `markers.origin_m` (see docs/design.md, Far origins).
    """

    rig: CameraRig
    markers: MarkerMap
    selector: Selector
    motion: Motion
    controller: Follower | None
    corner_sigma_px: Float[Array, ""]
    model_sigma_px: Float[Array, ""]
    repeated_errors: RepeatedErrors | None  # None with a single hypothesis, which doubts nothing
    max_sightings: int | None = eqx.field(static=True)
    max_candidates: int = eqx.field(static=True)
    max_lm_steps: int = eqx.field(static=True)
    ground_plane: bool = eqx.field(static=True)
    lag_s: float = eqx.field(static=True)
    lag_observations: int = eqx.field(static=True)

    def __init__(
        self,
        rig: CameraRig,
        markers: MarkerMap,
        vehicle: Vehicle | TwistBase | None = None,
        waypoints_m: Sequence[Sequence[float]] | Float[Array, "W 2"] = (),
        waypoint_radius_m: float = 0.15,
        selector: Selector | None = None,
        motion: Motion | None = None,
        proportional_per_m: float = 0.03,
        integral_per_ms: float = 0.005,
        integral_limit_ms: float = 5.0,
        corner_sigma_px: float = 1.0,
        model_sigma_px: float = MODEL_SIGMA_PX,
        repeated_errors: RepeatedErrors | None = None,
        max_sightings: int | None = None,
        max_candidates: int = 4,
        max_lm_steps: int = 12,
        ground_plane: bool = False,
        lag_s: float = 0.0,
        lag_observations: int = 64,
    ):
        """See the fields of `Controller`, `Snapshot`, `find_candidates` and the motion models.

        Args:
            lag_s: `step` also tells the pose of so long ago by all that was seen since; 0: not.
            lag_observations: how many are kept for it: `lag_s` times their rate, at least.

        Raises:
            ValueError: waypoints without a vehicle, or of the wrong shape; a lag that is no time.
        """
        if not 0 <= lag_s < float("inf") or lag_observations < 1:
            raise ValueError(f"no lag: {lag_s} s in {lag_observations} observations")
        self.rig, self.markers = rig, markers
        self.selector = selector or MultiHypothesis()
        self.motion = motion or (BicycleKalman(vehicle) if vehicle else ConstantVelocity())
        if isinstance(self.selector, Ungated):
            self.selector = self.selector.rule
            self.motion = eqx.tree_at(lambda m: m.gate_nis, self.motion, float("inf"))
        self.motion = self.motion.for_rig(rig, self.selector.hypotheses)
        self.controller = follower_along(
            waypoints_m, vehicle, waypoint_radius_m, proportional_per_m=proportional_per_m,
            integral_per_ms=integral_per_ms, integral_limit_ms=integral_limit_ms,
        )  # fmt: skip
        self.corner_sigma_px = jnp.asarray(corner_sigma_px, float)
        self.model_sigma_px = jnp.asarray(model_sigma_px, float)
        self.repeated_errors = repeated_errors or (
            RepeatedErrors() if self.selector.hypotheses > 1 else None
        )
        self.max_sightings = max_sightings
        self.max_candidates = max_candidates
        self.max_lm_steps = max_lm_steps
        self.ground_plane = ground_plane
        self.lag_s, self.lag_observations = lag_s, lag_observations

    def init(self) -> State:
        """The state before the first observation, at the first waypoint."""
        bank = self.motion.init(self.selector.hypotheses)
        control = None if self.controller is None else self.controller.init()
        window = Window.begin(bank, self.lag_s, self.lag_observations) if self.lag_s else None
        return State(self.believe(bank), control, window)

    def believe(self, bank: Bank) -> Belief:
        """The belief in these hypotheses before the first observation."""
        repeated = self.repeated_errors
        repeats = None if repeated is None else repeated.begin(self.rig, self.markers)
        return Belief.begin(bank, repeats)

    def step(self, state: State, obs: Observation) -> tuple[State, Output]:
        """One pass of Algorithm 1: sense, then act.

        Args:
            state: after the previous observation, or `init()`.
            obs: corners (C, M, 4, 2), odometry, and the time since the previous observation.
        """
        belief, estimate = self.sense(state.belief, obs)
        control, output = self.act(state.control, estimate, obs)
        window = state.window
        if window is not None:
            window = window.after(self.motion, state.belief.bank, belief.bank, obs.usable())
            output = replace(output, lagged=window.look_back(self.motion, belief))
        return State(belief, control, window), output

    def sense(self, belief: Belief, obs: Observation) -> tuple[Belief, Estimate]:
        """Fuse an observation: the next belief, and the estimate that is reported of it."""
        return self.fuse(belief, self.look(obs.usable()))

    def fuse(self, belief: Belief, seen: ConsistentSnapshot) -> tuple[Belief, Estimate]:
        """Predict a belief, then correct it by the markers in view, if there are any."""
        predicted = self.predict(belief, seen.snapshot.obs)
        belief, evidence = jax.lax.cond(
            jnp.any(seen.snapshot.seen.visible),
            lambda: self.correct(predicted, seen),
            lambda: self.coast(predicted),
        )
        return belief, Estimate.from_belief(self.motion, belief, evidence)

    def look(self, obs: Observation) -> ConsistentSnapshot:
        """Find the candidate poses of an observation; leave out what can be no marker."""
        return remove_outliers(self.snapshot(obs), self.find_candidates, self.no_candidates())

    def predict(self, belief: Belief, obs: Observation) -> Belief:
        """Predict the belief `obs.dt_s` later (Eq. 9), and fuse the odometry, if there is any."""
        bank = self.motion.sound(self.motion.predict(belief.bank, obs))
        given_up = jnp.any(belief.bank.initialised) & ~jnp.any(bank.initialised)
        return replace(belief, bank=bank, restarts=belief.restarts + given_up)

    def correct(self, belief: Belief, seen: ConsistentSnapshot) -> tuple[Belief, Evidence]:
        """Select a pose for each predicted hypothesis (Eqs. 13-15), and update (Eqs. 10, 11)."""
        motion, snapshot = self.motion, seen.snapshot
        prior = renumber_if_empty(belief.bank)
        predicted = motion.poses(prior)
        model, repeats, weighed = self.repeated_errors, belief.repeats, snapshot
        if model is not None and repeats is not None:
            surprise = surprise_of(predicted, heaviest(prior), seen.candidates, snapshot)
            weighed = model.weighed(repeats, snapshot, surprise)
        selection = self.selector(predicted, seen.candidates, weighed)
        updated = motion.update(prior, selection, snapshot.obs)
        bank = motion.sound(updated.bank)
        updated = updated._replace(bank=bank)
        evidence = Evidence.from_update(seen, prior, selection, updated, predicted.gate_nis)
        best = motion.T_world_vehicle(bank.mean[heaviest(bank)])
        if model is not None and repeats is not None:
            repeats = model.after(repeats, snapshot, best, selection.decided & evidence.agrees)
        flip_probability = selection.flip_probability.astype(belief.flip_probability.dtype)
        belief = Belief(bank, selection.decided, flip_probability, belief.restarts, repeats)
        return belief, evidence

    def coast(self, belief: Belief) -> tuple[Belief, Evidence]:
        """Carry a predicted belief on, where no marker is in view."""
        located = jnp.any(belief.bank.initialised)
        coasted = replace(
            belief,
            decided=belief.decided & located,
            flip_probability=jnp.where(located, belief.flip_probability, 0),
        )
        return coasted, self.no_evidence(belief)

    def act(
        self, control: ControlState | None, estimate: Estimate, obs: Observation
    ) -> tuple[ControlState | None, Output]:
        """The command at the estimated pose (Eqs. 16-19).

        Args:
            obs: its speed, steering angle and `dt_s`, the time since the last command, are used.
        """
        command, done, log = None, jnp.asarray(False), None
        if self.controller is not None and control is not None:
            speed_mps, steering_rad, dt_s = obs.usable().driven(estimate.pose.dtype)
            given = ControlInput(
                estimate.pose, estimate.located, steering_rad, dt_s, estimate.decided,
                self.markers.nearest_m(estimate.T_world_vehicle), speed_mps,
            )  # fmt: skip
            control, command, done, log = self.controller(control, given)
        return control, Output(**vars(estimate), command=command, done=done, control_log=log)

    def snapshot(self, obs: Observation) -> Snapshot:
        """The observation with its rig and map, and its largest sightings."""
        sigmas_px = self.corner_sigma_px, self.model_sigma_px
        return Snapshot.create(self.rig, self.markers, obs, *sigmas_px, self.max_sightings)

    def find_candidates(self, snapshot: Snapshot, own: jaxlie.SE3 | None = None) -> Candidates:
        """Both poses of every sighting, refined; see `core.pose.candidates.find_candidates`."""
        limits = self.max_candidates, self.max_lm_steps, self.ground_plane
        return find_candidates(snapshot, *limits, own)

    def no_candidates(self) -> Candidates:
        """Candidates as many as `find_candidates` returns, none of them valid."""
        count = min(self.max_candidates, 2 * slots(self.rig, self.markers, self.max_sightings))
        return Candidates.none(count, self.rig.cameras.focal_px.dtype)

    def no_evidence(self, belief: Belief) -> Evidence:
        """The evidence of an observation without a marker in view."""
        return Evidence.none(self.no_candidates(), len(self.markers.ids), belief.bank.mean.dtype)

    __hash__ = object.__hash__  # by identity: `jax.jit(navigator.step)` hashes its owner


Step = Callable[[State, Observation], tuple[State, Output]]


@jax.jit
def jitted_step(navigator: Navigator, state: State, obs: Observation) -> tuple[State, Output]:
    """`navigator.step`, compiled once for all navigators with the same tree structure."""
    return navigator.step(state, obs)
