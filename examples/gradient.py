"""A gradient through `Navigator.step`: which process noise explains a drive best?

The log-likelihood of a drive's corners, given what the filter had predicted, is summed over a scan
of `step`. `jax.grad` differentiates it with respect to the logarithm of the process noise Q,
through the pose solver and the filter; a finite difference checks it.

    python examples/gradient.py
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from drive import NOISE_PX, QCAR, simulate  # examples/drive.py

import jaxnav as jn
from jaxnav.simulation.plant import CarState


def make_observations(navigator: jn.Navigator, frames: int, dt_s: float = 0.1) -> jn.Observation:
    """A curve in sight of the marker, leading axis (frames,)."""
    start, zero = jnp.array([0.3, -0.6, 1.7]), jnp.zeros(())  # x_m, y_m, psi_rad; at rest
    car, command = CarState(start, zero, zero), jn.Command(zero + 0.3, zero + 0.04)
    seen = []
    for frame in range(frames):
        key = jax.random.fold_in(jax.random.key(0), frame)
        car, obs = simulate(navigator, car, command, jnp.asarray(dt_s), key)
        seen.append(obs)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *seen)


def main(frames: int = 20, h: float = 1e-2) -> dict[str, np.ndarray]:
    """Differentiate and check.

    Args:
        h: step of the finite difference, of log Q.

    Returns:
        gradient, difference: (3,), per unit of log Q, along, across and turning.
    """
    motion = jn.BicycleKalman(jn.load_vehicle(QCAR / "vehicle.yaml"))
    rig, markers = jn.load_rig(QCAR / "rig.yaml"), jn.load_markers(QCAR / "markers.yaml")
    navigator = jn.Navigator(
        rig, markers, motion=motion, selector=jn.PaperCost(), corner_sigma_px=NOISE_PX
    )
    observations = make_observations(navigator, frames)

    def log_likelihood(log_q):
        q = jnp.exp(log_q)  # (m/s^2)^2/Hz twice, (rad/s^2)^2/Hz
        tuned = eqx.tree_at(lambda n: n.motion.acceleration_density, navigator, q)

        def frame(state, obs):
            state, out = tuned.step(state, obs)
            return state, out.log_likelihood

        return jnp.sum(jax.lax.scan(frame, tuned.init(), observations)[1])

    value_and_grad = jax.jit(jax.value_and_grad(log_likelihood))
    log_q = jnp.log(motion.acceleration_density)
    value, gradient = value_and_grad(log_q)
    steps = h * jnp.eye(3, dtype=log_q.dtype)
    sides = [[float(value_and_grad(log_q + s * step)[0]) for s in (1, -1)] for step in steps]
    difference = np.array([(ahead - behind) / (2 * h) for ahead, behind in sides])
    print(f"log-likelihood of {frames} frames: {value:.3f}")
    for name, one, other in zip(("along", "across", "turning"), gradient, difference, strict=True):
        print(f"d / d log Q {name:8} gradient {one:9.5f}   finite difference {other:9.5f}")
    return {"gradient": np.asarray(gradient), "difference": difference}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)  # a finite difference loses half of the digits
    main()
