"""Project through a lens, with derivatives, and invert it; a new lens is a row of `LENSES`.

The coordinate axis comes first: points (3, ...) in m in the camera frame, images (2, ...) at focal
length 1, slopes (3, 2, ...) with respect to the point's coordinates, per m. Coefficients are in the
order of OpenCV, each a number or an array that broadcasts with the points; a lens gets its own.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from jaxtyping import Array, Bool, Float

from jaxnav.core.models import lens_equidistant, lens_pinhole, lens_sphere
from jaxnav.core.models.lens_parts import Image

_INFINITE = float("inf")


class LensModel(NamedTuple):
    """A kind of lens: its coefficients, its projection and the inverse."""

    coefficients: tuple[str, ...]
    # Of points and coefficients, with the slope.
    image: Callable[[Float[Array, "3 ..."], Float[Array, "k ..."]], Image]
    # Unit vectors through images.
    bearing: Callable[[Float[Array, "*batch 2"], Float[Array, " k"]], Float[Array, "*batch 3"]]
    # Whether points can be seen: before the lens, and before its image stops moving outwards.
    sees: Callable[[Float[Array, "3 ..."], Float[Array, "k ..."]], Bool[Array, "..."]]
    # Coefficients that the formula bounds: the least and the most.
    within: Mapping[str, tuple[float, float]] = {}


_BROWN = ("k1", "k2", "p1", "p2", "k3")
_BELOW = ("k4", "k5", "k6")
_BENT = (lens_pinhole.radtan, lens_pinhole.radtan_bearing, lens_pinhole.radtan_sees)
_ALPHA = (0.0, 1.0)
LENSES = {
    "none": LensModel(
        (), lens_pinhole.pinhole, lens_pinhole.pinhole_bearing, lens_pinhole.pinhole_sees
    ),
    "radtan": LensModel(_BROWN, *_BENT),
    "rational": LensModel((*_BROWN, *_BELOW), *_BENT),
    "thin_prism": LensModel((*_BROWN, *_BELOW, "s1", "s2", "s3", "s4"), *_BENT),
    "equidistant": LensModel(
        ("k1", "k2", "k3", "k4"),
        lens_equidistant.equidistant,
        lens_equidistant.equidistant_bearing,
        lens_equidistant.equidistant_sees,
    ),
    "omni": LensModel(
        ("xi", "k1", "k2", "p1", "p2"),
        lens_sphere.omni,
        lens_sphere.omni_bearing,
        lens_sphere.omni_sees,
        {"xi": (0.0, _INFINITE)},
    ),
    "double_sphere": LensModel(
        ("xi", "alpha"),
        lens_sphere.double_sphere,
        lens_sphere.double_sphere_bearing,
        lens_sphere.double_sphere_sees,
        {"xi": (-0.99, 1.0), "alpha": _ALPHA},
    ),
    "eucm": LensModel(
        ("alpha", "beta"),
        lens_sphere.eucm,
        lens_sphere.eucm_bearing,
        lens_sphere.eucm_sees,
        {"alpha": _ALPHA, "beta": (0.0, _INFINITE)},
    ),
}
MOST_COEFFICIENTS = max(len(lens.coefficients) for lens in LENSES.values())


def image_of(
    lens: str, points: Float[Array, "3 ..."], coefficients: Float[Array, "12 ..."]
) -> Image:
    """Images (2, ...) at focal length 1 of points (3, ...), and their slopes (3, 2, ...)."""
    kind = LENSES[lens]
    return kind.image(points, coefficients[: len(kind.coefficients)])


def can_be_seen(
    lens: str, points: Float[Array, "3 ..."], coefficients: Float[Array, "12 ..."]
) -> Bool[Array, "..."]:
    """Whether points (3, ...) lie before the lens, and where its image is still one-to-one.

    A lens that was fitted up to some angle may fold beyond: it draws points from there into the
    image that no camera sees there.
    """
    kind = LENSES[lens]
    return kind.sees(points, coefficients[: len(kind.coefficients)])


def bearing_of(
    lens: str, xy: Float[Array, "*batch 2"], coefficients: Float[Array, " 12"]
) -> Float[Array, "*batch 3"]:
    """Unit vectors (..., 3) in the camera frame through images (..., 2) at focal length 1."""
    kind = LENSES[lens]
    return kind.bearing(xy, coefficients[: len(kind.coefficients)])
