"""Follow markers of known ids through blur, shade and what hides a part of them.

Where the filter expects a marker, its whole pattern is fitted to the raw pixels: no quadrilateral
needs to be found and no cell to be read. A marker counts as seen if the pattern explains the pixels
and no other code of the family comes near.

    tracks = track(image, camera, [Target("tag36h11", 7, quads_px, radius_px=12.0)])
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.core.models.camera import Camera
from jaxnav.detection.disturbed_fit import fit_disturbed
from jaxnav.detection.families import codes_of, marker_cells, printed
from jaxnav.detection.lens import Lens
from jaxnav.detection.patch_fit import MOST_STREAK_PX, PatchFit
from jaxnav.detection.refine import mean_side_px, refine_corners
from jaxnav.detection.template import best_match

_SIDES_PX = (8.0, 120.0)  # of a marker that is followed; a larger one takes too long
_LEAST_CONTRAST = 10.0  # grey levels
# What decides, see `benchmarks/README-blur.md`: of the loss without a marker the part that it
# explains, by how many noise variances every other code is worse, and how far, of a side, the fit
# moved a corner from where the picture matched best.
_LEAST_EXPLAINED = 0.5
_LEAST_ADVANTAGE = 70.0  # of white noise
_MOST_MOVED = 0.25
_MODEL_SIGMA_PX = 0.008
_WARM_CELL_PX = 4  # with more pixels than a first fit takes: see `PatchFit.finer`
_STREAK_SIGMA_PX = 0.5  # where the streak is as long as the marker's side


@dataclass(frozen=True)
class Target:
    """A marker that is expected in an image.

    Attributes:
        family: one of `jaxnav.core.models.markers.FAMILY_SIZES`.
        marker_id: its id.
        quads_px: (H, 4, 2), where its corners may be, TL TR BR BL: a place for each hypothesis.
        radius_px: the farthest that it may be from them.
        streak_px: (2,), the expected streak of its centre during the exposure; one of more than
            `MOST_STREAK_PX` counts as not known.
        streak_sigma_px: standard deviation of that; infinite where the motion is not known.
    """

    family: str
    marker_id: int
    quads_px: Float[np.ndarray, "H 4 2"]
    radius_px: float
    streak_px: tuple[float, float] = (0.0, 0.0)
    streak_sigma_px: float = math.inf


@dataclass(frozen=True)
class Track:
    """A marker that was followed into an image.

    Attributes:
        corners_px: (4, 2), TL TR BR BL, in the middle of the exposure.
        covariance_px2: (8, 8), of the corners, u and v of each in turn.
        streak_px: (2,), of its centre during the exposure; its sign is the expected one's.
        explained: 0 to 1, the part of the loss without a marker that the marker explains.
        advantage: noise variances by which the nearest other code of the family is worse.
    """

    family: str
    marker_id: int
    corners_px: Float[np.ndarray, "4 2"]
    covariance_px2: Float[np.ndarray, "8 8"]
    streak_px: Float[np.ndarray, " 2"]
    explained: float
    advantage: float

    @property
    def sigma_px(self) -> Float[np.ndarray, " 4"]:
        """Standard deviation (4,) of each corner along an axis (RMS of the two)."""
        variances = np.diagonal(self.covariance_px2).reshape(4, 2)
        return np.asarray(np.sqrt(variances.mean(axis=1)))


def track(
    image: UInt8[np.ndarray, "rows columns"],
    camera: Camera | None,
    targets: Sequence[Target],
    most_disturbed: float = math.inf,
) -> list[Track | None]:
    """Follow markers into an image, each on its own; None for one that is not seen.

    Args:
        image: (H, W) grey levels.
        camera: makes edges straight in the world; without it, straight in the image.
        most_disturbed: of so many markers, in the order of the targets, a shadow or what hides a
            part is looked for: that takes ten times as long as a marker that is in plain view.
    """
    tracks: list[Track | None] = []
    for target in targets:
        fit = first_fit(image, camera, target)
        if fit is not None and fit.is_disturbed:
            most_disturbed -= 1
            fit = fit_disturbed(fit) if most_disturbed >= 0 else None
        tracks.append(None if fit is None else _judge(target, fit))
    return tracks


def warm_up_fits(camera: Camera | None, family: str, marker_id: int, tracks: bool) -> None:
    """Compile or load all that detectors of a family call, whatever their images will show.

    Which programs these are depends on the kind of lens, on how many cells a marker has, and for
    `track` on the family. So what is fitted here is a marker that is always found: in the middle of
    a lens of that kind, which bends nothing there.

    Args:
        camera: as in `Detector.detect`.
        marker_id: of the family.
        tracks: also what `track` calls.
    """
    image, quad_px = printed(family, marker_id, _WARM_CELL_PX)
    if camera is not None:
        side_px = np.full_like(np.asarray(camera.focal_px), len(image))
        straight = np.zeros_like(np.asarray(camera.distortion))
        camera = eqx.tree_at(
            lambda one: (one.focal_px, one.center_px, one.distortion),
            camera,
            (side_px, side_px / 2, straight),
        )
    lens = Lens(camera)
    refined = refine_corners(image, quad_px, marker_cells(family, marker_id), lens)
    assert refined.fitted is not None  # else its programs would be missing in mid-drive
    codes_of(family)  # as long as a fit
    if tracks:
        key = family, marker_id
        fit = PatchFit.begin(image, camera, key, quad_px, np.zeros(2), math.inf)
        assert fit is not None
        fit.again().finer()


def first_fit(image: np.ndarray, camera: Camera | None, target: Target) -> PatchFit | None:
    """The fit that starts where the marker's picture matches best; None where none does."""
    sides_px = [mean_side_px(quad) for quad in target.quads_px if np.all(np.isfinite(quad))]
    if not sides_px or not _SIDES_PX[0] <= max(sides_px) <= _SIDES_PX[1]:
        return None
    streak_px, streak_sigma_px = target.streak_px, target.streak_sigma_px
    if not math.hypot(*streak_px) <= MOST_STREAK_PX:
        streak_px, streak_sigma_px = (0.0, 0.0), math.inf
    key = target.family, target.marker_id
    start = best_match(
        image, *key, target.quads_px, target.radius_px, streak_px, streak_sigma_px
    )  # fmt: skip
    if start is None:
        return None
    streak = np.asarray(start.streak_px)
    fit = PatchFit.begin(image, camera, key, start.quad_px, streak, streak_sigma_px)
    return None if fit is None or not np.all(np.isfinite(fit.summary.corners_px)) else fit


def _judge(target: Target, patch_fit: PatchFit) -> Track | None:
    """The track if the fit is the marker's, else None."""
    fit, start_px = patch_fit.summary, np.asarray(patch_fit.patch.quad_px, float)
    if not fit.contrast >= max(_LEAST_CONTRAST, 2 * fit.noise):
        return None
    corners_px = np.asarray(fit.corners_px, float)
    side_px = mean_side_px(start_px)
    moved_px = np.linalg.norm(corners_px - start_px, axis=1)
    if not np.all(moved_px < max(3.0, _MOST_MOVED * side_px)):
        return None
    # A sum of squares deviates by the root of the factor by which neighbours' noise is alike. Where
    # cells disagree that is a factor of the noise as well.
    advantage = fit.advantage / np.sqrt(fit.alike) / max(fit.disagreement, 1.0) ** 1.5
    if not (fit.explained >= _LEAST_EXPLAINED and advantage >= _LEAST_ADVANTAGE):
        return None
    streak_px = np.asarray(fit.streak_px, float)
    # What residuals don't show: a streak as long as the marker mixes the ground into all of it.
    streaks = min(float(np.hypot(*streak_px)) / side_px, 2.0)
    sigma_px = _MODEL_SIGMA_PX + _STREAK_SIGMA_PX * streaks**4
    covariance = np.asarray(fit.covariance_px2, float) + sigma_px**2 * np.eye(8)
    if not np.all(np.isfinite(covariance)):
        return None
    if streak_px @ np.asarray(target.streak_px) < 0:
        streak_px = -streak_px
    return Track(
        target.family, target.marker_id, corners_px, covariance, streak_px,
        float(fit.explained), float(fit.advantage),
    )  # fmt: skip
