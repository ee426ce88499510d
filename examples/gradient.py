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
from jaxnav.sim.plant import CarState


def main(frames: int = 20, h: float = 1e-2) -> tuple[np.ndarray, np.ndarray]:
    """Returns: gradient and finite difference of step h, (3,): along, across and turning."""
    motion = jn.BicycleKalman(jn.load_vehicle(QCAR / "vehicle.yaml"))
    rig, markers = jn.load_rig(QCAR / "rig.yaml"), jn.load_markers(QCAR / "markers.yaml")
    navigator = jn.Navigator(
        rig, markers, motion=motion, selector=jn.PaperCost(), corner_sigma_px=NOISE_PX
    )
    # A curve in sight of the marker, from rest: 10 frames a second at the same command.
    start_pose, zero = jnp.array([0.3, -0.6, 1.7]), jnp.zeros(())  # x_m, y_m, psi_rad
    car, command = CarState(start_pose, zero, zero), jn.Command(zero + 0.3, zero + 0.04)
    keys = jax.random.split(jax.random.key(0), frames)
    _, observations = jax.lax.scan(
        lambda car, key: simulate(navigator, car, command, zero + 0.1, key), car, keys
    )

    @jax.jit
    def log_likelihood(log_q):
        q = jnp.exp(log_q)  # (m/s^2)^2/Hz twice, (rad/s^2)^2/Hz
        tuned = eqx.tree_at(lambda n: n.motion.acceleration_density, navigator, q)
        _, outputs = jax.lax.scan(tuned.step, tuned.init(), observations)
        return jnp.sum(outputs.log_likelihood)

    log_q = jnp.log(motion.acceleration_density)
    value, gradient = jax.value_and_grad(log_likelihood)(log_q)
    steps = h * jnp.eye(3, dtype=log_q.dtype)
    sides = [log_likelihood(log_q + step) - log_likelihood(log_q - step) for step in steps]
    difference = np.array(sides) / (2 * h)
    print(f"log-likelihood of {frames} frames: {value:.3f}")
    for name, one, other in zip(("along", "across", "turning"), gradient, difference, strict=True):
        print(f"d / d log Q {name:8} gradient {one:9.5f}   finite difference {other:9.5f}")
    return np.asarray(gradient), difference


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)  # a finite difference loses half of the digits
    main()
