"""What the filters of bodies that move freely share: pose on SE(3), twist, and the rest behind."""

import abc
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter import kalman
from jaxnav.core.filter.ambiguity import PoseBelief, PoseMeasurement, PosePosterior
from jaxnav.core.filter.bank import Bank, contradicted, empty_bank, forget_lost, heaviest, known_to
from jaxnav.core.filter.camera_errors import (
    EACH,
    CameraErrors,
    common_turn,
    not_told,
)
from jaxnav.core.filter.follow_pose import follow_pose
from jaxnav.core.filter.gate import Moments, Offer
from jaxnav.core.filter.motion import Motion, camera_states
from jaxnav.core.linalg.small_matrices import cholesky, log_det, matvec, product
from jaxnav.core.models.geometry import (
    cayley,
    inverse_cayley,
    planar_from_T_world_vehicle,
    rotation_error_rad,
    rotation_matrix,
)
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Observation


class FreeBody(Motion):
    """A body that is free in six directions.

    The mean is (wxyz, xyz) of T_world_vehicle, the twist (m/s, rad/s) in vehicle axes, further
    states of the model, the errors of its sensors, and those of the cameras; the error states are
    xi in `T_world_vehicle * cay(xi)`, and the errors of all others.
    """

    acceleration_density: eqx.AbstractVar[Float[Array, " 6"] | Float[Array, "6 6"]]
    vision_floor: eqx.AbstractVar[Float[Array, " 6"] | Float[Array, "6 6"]]
    camera_states: eqx.AbstractVar[int]
    camera_turn_sigma_rad: eqx.AbstractVar[Float[Array, "C 3"] | None]
    learn_sigma_rad: eqx.AbstractVar[float]
    lost_sigma_m: eqx.AbstractVar[float]
    gate_nis: eqx.AbstractVar[float]
    max_rejections: eqx.AbstractVar[int]
    max_rejected_s: eqx.AbstractVar[float]

    @abc.abstractmethod
    def at_first(self) -> Moments:
        """Mean and covariance of what a first pose does not tell, but for the cameras' errors."""

    def init(self, hypotheses: int = 1) -> Bank:
        """A bank of K hypotheses before the first pose."""
        dtype, rest = self.acceleration_density.dtype, self.at_first()[0]
        count = 6 + rest.shape[0] + self.camera_states
        mean = jnp.zeros(1 + count, dtype).at[0].set(1)
        mean = mean.at[7 : 7 + rest.shape[0]].set(rest.astype(dtype))
        return empty_bank(mean, jnp.eye(count, dtype=dtype), 6, hypotheses)

    def without_lost(
        self,
        before: Bank,
        mean: Float[Array, "K n"],
        covariance: Float[Array, "K d d"],
        dt_s: Float[Array, ""],
    ) -> Bank:
        """The bank with the predicted moments, less hypotheses that are contradicted or nowhere."""
        bank = eqx.tree_at(lambda b: (b.mean, b.covariance), before, (mean, covariance))
        variance_m2 = jnp.max(jnp.diagonal(covariance, axis1=1, axis2=2)[:, :3], axis=1)
        lost = self.lost(before) | ~(variance_m2 < self.lost_sigma_m**2)
        return forget_lost(bank, lost, dt_s)

    def lost(self, bank: Bank) -> Bool[Array, " K"]:
        """Whether the gate has contradicted a hypothesis too often or too long."""
        return contradicted(bank, self.max_rejections, self.max_rejected_s)

    def poses(self, bank: Bank) -> PoseBelief:
        """The pose part of the state: free in six directions, without nuisances."""
        return PoseBelief(
            jaxlie.SE3(bank.mean[:, :7]),
            bank.covariance[:, :6, :6],
            bank.log_weight,
            bank.initialised,
            jnp.eye(6, dtype=bank.mean.dtype),
            jnp.zeros((6, 0), bank.mean.dtype),
            self.gate_nis,
            self._camera_errors(bank),
        )

    def _camera_errors(self, bank: Bank) -> CameraErrors | None:
        if not self.camera_states:
            return None
        P = bank.covariance
        behind = P.shape[-1] - self.camera_states
        return CameraErrors(bank.mean[:, behind + 1 :], P[:, behind:, behind:], P[:, :6, behind:])

    def measure(self, bank: Bank, measured: PoseMeasurement, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has chosen a candidate, in 6 dof."""
        mean, P = bank.mean, bank.covariance
        log_volume = log_det(cholesky(measured.covariance)) / 2
        R = measured.covariance + kalman.as_covariance(self.vision_floor)
        innovation = inverse_cayley(jaxlie.SE3(mean[:7]).inverse() @ measured.T_world_vehicle)
        correction, posterior, S = kalman.update(P, innovation, jnp.eye(6, dtype=P.dtype), R)
        return Offer(
            kalman.whiten(innovation, S),
            gate_nis=self.gate_nis,
            log_likelihood=measured.log_misfit + log_volume + kalman.log_likelihood(innovation, S),
            posterior=(self.moved(mean, correction), posterior),
        )

    def follow(self, bank: Bank, measured: PosePosterior, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has corrected its pose, in 6 dof."""
        T = measured.T_world_vehicle
        correction, P = follow_pose(
            bank.covariance,
            jaxlie.SE3(bank.mean[:7]),
            measured,
            jnp.eye(6, dtype=bank.mean.dtype),
            self.states,
        )
        if measured.errors is not None and self.camera_turn_sigma_rad is not None:
            sigma_rad = jnp.asarray(self.camera_turn_sigma_rad, P.dtype)
            common = common_turn(measured.errors, sigma_rad)
            correction, P = not_told(common, bank.covariance, correction, P)
        return Offer(
            measured.innovation,
            gate_nis=self.gate_nis,
            log_likelihood=measured.log_likelihood,
            inflation=measured.inflation,
            posterior=(jnp.append(T.wxyz_xyz, bank.mean[7:] + correction[6:]), P),
        )

    def difference(self, mean: Float[Array, " n"], base: Float[Array, " n"]) -> Float[Array, " d"]:
        """(xi, difference of the twists), (12,): mean = base * cay(xi), in the axes of `base`."""
        T_base_other = jaxlie.SE3(base[:7]).inverse() @ jaxlie.SE3(mean[:7])
        return jnp.append(inverse_cayley(T_base_other), mean[7:] - base[7:])

    def moved(self, base: Float[Array, " n"], error: Float[Array, " d"]) -> Float[Array, " n"]:
        """The mean (13,) at an error (12,): base * cay(xi), and the twist plus its error."""
        T = (jaxlie.SE3(base[:7]) @ cayley(error[:6])).normalize()
        return jnp.append(T.wxyz_xyz, base[7:] + error[6:])

    def T_world_vehicle(self, mean: Float[Array, " n"]) -> jaxlie.SE3:
        """The pose of a mean."""
        return jaxlie.SE3(mean[:7])

    def on_ground(self, mean: Float[Array, " n"]) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
        """(x, y, psi) and (v_x, v_y, psi_dot) in the world: pose and motion seen from above."""
        T_world_vehicle = jaxlie.SE3(mean[:7])
        R_world_vehicle = rotation_matrix(T_world_vehicle.rotation())
        v_mps, w_radps = matvec(R_world_vehicle, mean[7:10]), matvec(R_world_vehicle, mean[10:13])
        # psi is the direction of the x axis, which moves by w x (R e_x).
        x, y, up = R_world_vehicle[:, 0]
        level = jnp.maximum(x**2 + y**2, jnp.finfo(mean.dtype).eps)
        turn_radps = w_radps[2] - up * (x * w_radps[0] + y * w_radps[1]) / level
        return planar_from_T_world_vehicle(T_world_vehicle), jnp.append(v_mps[:2], turn_radps)

    def for_rig(self, rig: CameraRig, hypotheses: int) -> "FreeBody":
        """The model with the errors of the rig's cameras among its states."""
        count = camera_states(rig, hypotheses)
        turns = None if rig.extrinsics_sigma is None else rig.extrinsics_sigma[:, EACH:]
        turns = turns if count else None
        return dataclasses.replace(self, camera_states=count, camera_turn_sigma_rad=turns)

    def learns(self, bank: Bank) -> Bool[Array, ""]:
        """Whether the orientation is known to `learn_sigma_rad`."""
        best = jaxlie.SE3(bank.mean[heaviest(bank), :7])
        apart = jax.vmap(lambda mean: rotation_error_rad(jaxlie.SE3(mean[:7]), best))(bank.mean)
        variance = jnp.trace(bank.covariance[:, 3:6, 3:6], axis1=1, axis2=2)
        return known_to(bank, apart, variance) < self.learn_sigma_rad**2

    def start(
        self, bank: Bank, measured: PoseMeasurement | PosePosterior, obs: Observation
    ) -> Moments:
        """One hypothesis that begins at a measured pose, moving as little as is known."""
        wxyz_xyz, dtype = measured.T_world_vehicle.wxyz_xyz, bank.mean.dtype
        covariance, errors = measured.covariance, None
        if isinstance(measured, PosePosterior):
            errors = measured.errors
        else:
            covariance = covariance + kalman.as_covariance(self.vision_floor)
        mean, of_rest = (x.astype(dtype) for x in self.at_first())
        behind = 6 + mean.shape[0]
        cameras = jnp.ones(self.camera_states, dtype)
        P = jnp.diag(jnp.concatenate([jnp.zeros(behind, dtype), cameras]))
        P = P.at[:6, :6].set(covariance).at[6:behind, 6:behind].set(of_rest)
        if errors is not None:
            cross = product(covariance, product(errors.slope.T, errors.rows))
            P = P.at[:6, behind:].set(cross).at[behind:, :6].set(cross.T)
        return jnp.concatenate([wxyz_xyz, mean, jnp.zeros_like(cameras)]), P


def moved_by_twist(
    mean: Float[Array, " n"],
    P: Float[Array, "d d"],
    twist: Float[Array, " 6"],
    dt_s: Float[Array, ""],
    own: Bool[Array, ""] | bool,
) -> Moments:
    """Mean and covariance where the body has had a twist for `dt_s`.

    T = T exp(u dt),  P = F P F',  F = [Ad(exp(-u dt)), dt I; 0, I], or 0 in the place of dt I where
    the twist is not the state's `own`.
    """
    dtype = mean.dtype
    motion = jaxlie.SE3.exp(twist * dt_s)
    T_world_vehicle = (jaxlie.SE3(mean[:7]) @ motion).normalize()
    by_twist = jnp.where(own, dt_s, 0) * jnp.eye(6, dtype=dtype)
    F = jnp.concatenate([motion.inverse().adjoint(), by_twist], axis=1)
    mean = jnp.concatenate([T_world_vehicle.wxyz_xyz, twist, mean[13:]])
    return mean, kalman.replace_first(P, F)
