"""Corner errors that repeat from frame to frame, and how little a repeated sighting tells.

A lens residual, a marker that is not flat and blur are the same in the next frame, as long as the
marker's image has hardly moved. Of the variance sigma^2 of a corner a share s repeats. After n
sightings with the same repeated error the mean of n + 1 has the variance

    v(n + 1) = sigma^2 ((1 - s) / (n + 1) + s)

instead of sigma^2 / (n + 1), so the next sighting counts as one of the variance

    sigma_n^2 = 1 / (1 / v(n + 1) - 1 / v(n))
              = sigma^2 (1 - s + (n + 1) s) (1 - s + n s) / (1 - s).

The first counts in full, and many of a vehicle that stands add up to 1 / (s sigma^2) at most.

Source: Bayley, Hammersley (1946), "The 'effective' number of independent observations in an
autocorrelated time series".
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig
from jaxnav.pose.observation import Observation, Snapshot


class Repeats(eqx.Module):
    """The last sighting of each marker by each camera, and how many before it had its errors."""

    corners_px: Float[Array, "C M 4 2"]
    count: Float[Array, "C M"]

    @staticmethod
    def none(rig: CameraRig, markers: MarkerMap) -> "Repeats":
        """Nothing was seen yet."""
        lanes, dtype = (len(rig), len(markers.ids)), rig.cameras.focal_px.dtype
        return Repeats(jnp.zeros((*lanes, 4, 2), dtype), jnp.zeros(lanes, dtype))


class RepeatedErrors(eqx.Module):
    """The share of a corner's variance that repeats, and how far an image moves until it is new.

    A navigator has none by default: with a share of 0.1 recordings are judged more honestly, but a
    picture that freezes leads a car farther astray before it is noticed.
    """

    share: float = 0.1
    renewal_px: float = 40.0  # by which corners have moved when 1 / e of their errors is the same

    def weighed(self, repeats: Repeats, snapshot: Snapshot) -> tuple[Snapshot, Repeats]:
        """The snapshot with the sigma of repeated sightings raised, and the sightings after it."""
        obs, seen = snapshot.obs, snapshot.seen
        still = self._still(repeats, obs)
        lane = seen.camera_index, seen.marker_index
        visible = jnp.zeros_like(obs.visible).at[lane].max(seen.visible)
        corners_px = jnp.asarray(obs.corners_px, still.dtype)
        after = Repeats(
            jnp.where(visible[..., None, None], corners_px, repeats.corners_px),
            jnp.where(visible, still + 1, repeats.count),
        )
        n, s = still[lane][:, None], self.share
        scale = jnp.sqrt((1 - s + (n + 1) * s) * (1 - s + n * s) / (1 - s))
        seen = dataclasses.replace(seen, sigma_px=seen.sigma_px * scale)
        return dataclasses.replace(snapshot, seen=seen), after

    def _still(self, repeats: Repeats, obs: Observation) -> Float[Array, "C M"]:
        """How many sightings had the errors of this one."""
        moved_px2 = jnp.sum((obs.corners_px - repeats.corners_px) ** 2, axis=(2, 3)) / 4
        moved_px2 = jnp.where(obs.visible, moved_px2, 0)
        far = moved_px2 > 0
        moved_px = jnp.where(far, jnp.sqrt(jnp.where(far, moved_px2, 1)), 0)
        return (repeats.count * jnp.exp(-moved_px / self.renewal_px)).astype(repeats.count.dtype)
