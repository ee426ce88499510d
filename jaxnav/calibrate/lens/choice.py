"""Choice of the views that tell most about the lens.

Source: Fedorov (1972), "Theory of optimal experiments": greedy D-optimality, each view chosen
raises the determinant of the information most.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.start import board_poses
from jaxnav.calibrate.lens.views import BoardViews

_WRONG = 10.0  # times the median view's error: a view beyond it tells nothing about the lens
_NO_CURVE = 1e-9  # of the total information, so that the first views have a determinant


def informative(
    views: BoardViews, lens: str, parameters: Float[np.ndarray, " 9"], most: int
) -> tuple[int, ...]:
    """Indices, in order, of the at most `most` views that tell most about the lens.

    Args:
        parameters: (9,) of the lens, roughly.
    """
    if len(views.views) <= most:
        return tuple(range(len(views.views)))
    poses = board_poses(views, lens, parameters)
    posed = ~np.isnan(poses[:, 0])
    seen, y = lens_bundle.padded(views, parameters, poses)
    # The poses alone, by pixels instead of rays.
    held = lens_bundle.solve(lens, y, seen, seen.present, np.zeros(lens_bundle.COUNT, bool))
    squared = np.sum(np.asarray(held.residual_px) ** 2, axis=(1, 2))[: len(poses)]
    rms_px = np.sqrt(squared / np.maximum([len(view.ids) for view in views.views], 1))
    sound = posed & (rms_px < _WRONG * np.median(rms_px[posed]))
    each, _ = lens_bundle.view_information(
        lens, held.unknowns, seen, jnp.asarray(seen.present, float)
    )
    free = lens_bundle.free_mask(lens)
    information = np.asarray(each)[: len(poses)][:, free][:, :, free]
    return _greedy(information, sound, most)


def _greedy(information: np.ndarray, sound: np.ndarray, most: int) -> tuple[int, ...]:
    total = np.sum(information[sound], axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    scaled = information * np.outer(scale, scale)
    known = _NO_CURVE * np.eye(len(scale))
    left = list(np.flatnonzero(sound))
    chosen: list[int] = []
    while left and len(chosen) < most:
        _, gain = np.linalg.slogdet(known + scaled[left])
        best = int(left.pop(int(np.argmax(gain))))
        chosen.append(best)
        known = known + scaled[best]
    return tuple(sorted(chosen))
