"""A selector of one's own, held against the default on the same drive.

A selector says which candidate pose each hypothesis of the filter takes. This one adds to the
corners' error the turn that a candidate asks for against the prediction: a car does not turn by
40 degrees between two frames. Like every selector that keeps one hypothesis it has to believe its
first pose; the default keeps several.

    python examples/own_selector.py
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from drive import drive, make_navigator  # examples/drive.py

import jaxnav as jn
from jaxnav.core.filter.bank import PoseBelief
from jaxnav.core.models.geometry import planar_from_T_world_vehicle, wrap_angle


class SteadyHeading(eqx.Module):
    """The candidate with the lowest e1 + (turn / turn_sigma_rad)^2."""

    hypotheses: ClassVar[int] = 1  # K
    turn_sigma_rad: float = 0.1  # as much as a corner error of one pixel

    def __call__(
        self, prior: PoseBelief, candidates: jn.Candidates, snapshot: jn.Snapshot
    ) -> jn.Selection:
        """Candidates have a leading axis (N,), the prediction (K,)."""
        Ts_world_vehicle = jax.vmap(lambda T: T.inverse())(candidates.T_vehicle_world)
        psi_rad = planar_from_T_world_vehicle(Ts_world_vehicle)[:, 2]
        predicted_rad = planar_from_T_world_vehicle(prior.T_world_vehicle)[0, 2]
        turn = wrap_angle(psi_rad - predicted_rad) / self.turn_sigma_rad
        costs = candidates.e1_px2 + jnp.where(prior.initialised[0], turn**2, 0)
        # The lowest of them: a selector that exists does the rest.
        changed = eqx.tree_at(lambda c: c.e1_px2, candidates, costs)
        return jn.LowestReprojection()(prior, changed, snapshot)


def main(duration_s: float = 20.0) -> dict[str, dict[str, float]]:
    """Drive with both; return what each made of it."""
    told = {}
    for name, selector in {"default": None, "SteadyHeading": SteadyHeading()}.items():
        times_s, errors_m, outputs = zip(*drive(make_navigator(selector), duration_s), strict=True)
        median_m, done = float(np.median(errors_m)), bool(outputs[-1].done)
        told[name] = {"time_s": times_s[-1], "median_error_m": median_m, "done": done}
        ended = f"{'arrived' if done else 'had not arrived'} after {times_s[-1]:.1f} s"
        print(f"{name:14} {ended}, median position error {100 * median_m:.1f} cm")
    return told


if __name__ == "__main__":
    main()
