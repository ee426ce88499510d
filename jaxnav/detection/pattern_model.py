"""The image of a marker under motion, a lens's blur and uneven light, by its unknowns.

    I(u) = (1, x, y) white - (1, x, y) contrast dark + (shadow - 1) (shade (1 - dark) + ink dark)
           + ground far + bend dark (1 - dark)

dark is the image of the ink and far that of the ground beyond the paper, see `image_model`."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.linalg.small_matrices import eliminate
from jaxnav.detection.image_model import Exposure, expose, is_informative
from jaxnav.detection.paper import on_paper

LIGHTS = 10
UNKNOWNS = 8 + 2 + 1 + LIGHTS
SHADES = slice(6, 8)  # of the light: by how much a shadow dims paper and ink
BEND = 9
LENS_PX2, _LENS_SIGMA_PX2 = 0.4, 0.5
# Standard deviations of the light's coefficients, over the contrast: gradients over half a side,
# shade of paper and of ink, ground beyond the paper, curve of the levels (sRGB has up to 0.95).
_LIGHT_SIGMA = (10.0, 0.5, 0.5, 10.0, 0.2, 0.2, 1.0, 0.3, 2.0, 0.6)


class Patch(NamedTuple):
    """The pixels around one marker's predicted place, padded to N, and what is expected there."""

    pixels: Float[Array, "N 2"]
    levels: Float[Array, " N"]
    real: Bool[Array, " N"]  # which pixels are no padding
    used: Bool[Array, " N"]  # which of them count in the fit
    shadow: Float[Array, " N"]  # 1 in the light, 0 in the shadow
    quad_px: Float[Array, "4 2"]  # about where the corners are
    K: Float[Array, "k k"]  # `step_corners` of the marker
    own: Int[Array, ""]  # which of the family's codes it is
    motion_px: Float[Array, " 2"]  # the expected streak
    motion_sigma_px: Float[Array, ""]
    contrast: Float[Array, ""]  # about that of the marker, grey levels
    ground: Float[Array, ""]  # standard deviation of the ground beyond the paper, of the contrast
    most_noise: Float[Array, ""]  # standard deviation of pixels that fit, at most
    instants: Int[Array, ""]  # see `expose`


class Window(NamedTuple):
    """A patch and the rays through its pixels, in a basis in which M is near the identity."""

    rays: Float[Array, "3 N"]
    rays_px: Float[Array, "2 3 N"]
    patch: Patch

    def first(self, count: int) -> "Window":
        """The window with its first pixels alone."""
        few = {name: getattr(self.patch, name)[:count] for name in ("levels", "used", "shadow")}
        return Window(self.rays[:, :count], self.rays_px[:, :, :count], self.patch._replace(**few))


class Unknowns(NamedTuple):
    M: Float[Array, "3 3"]
    motion_px: Float[Array, " 2"]
    lens_px2: Float[Array, ""]
    light: Float[Array, " L"]  # over the contrast


def exposure(y: Unknowns, window: Window) -> Exposure:
    """The image of the ink."""
    patch = window.patch
    return expose(
        y.M, y.motion_px, y.lens_px2, window.rays, window.rays_px, patch.K, patch.instants
    )


def model(y: Unknowns, window: Window) -> tuple[Float[Array, " N"], Float[Array, "n N"], Exposure]:
    """Residual (N,), slopes (n, N) of the model by all unknowns, and the ink's image."""
    image, patch = exposure(y, window), window.patch
    basis = basis_of(y, window, image)
    light = y.light * patch.contrast
    levels = light @ basis
    x, y_paper = on_paper(y.M, window.rays, window.rays_px)[0]
    contrast = light[3] + light[4] * x + light[5] * y_paper
    by_dark = light[BEND] * (1 - 2 * image.dark) - contrast
    by_dark = by_dark + (light[6] - light[7]) * (1 - patch.shadow)
    J = jnp.concatenate(
        [by_dark[None] * image.by_D, by_dark[None] * image.by_motion,
         (by_dark * image.by_lens)[None], patch.contrast * basis]
    )  # fmt: skip
    residual = patch.levels - levels
    known = is_informative(residual, patch.levels)
    return jnp.where(known, residual, 0), jnp.where(known[None], J, 0), image


def basis_of(y: Unknowns, window: Window, image: Exposure) -> Float[Array, "L N"]:
    """The levels are the light times these."""
    (x, y_paper), _ = on_paper(y.M, window.rays, window.rays_px)
    # Beyond the marker gradients end: the ground there has its own light.
    x, y_paper = jnp.clip(x, -1.5, 1.5), jnp.clip(y_paper, -1.5, 1.5)
    dark = image.dark
    shade = window.patch.shadow - 1
    return jnp.stack(
        [jnp.ones_like(x), x, y_paper, -dark, -dark * x, -dark * y_paper, shade * (1 - dark),
         shade * dark, image.far, dark * (1 - dark)]
    )  # fmt: skip


def first_light(y: Unknowns, window: Window) -> Float[Array, " L"]:
    """The light that suits all else, by least squares."""
    patch = window.patch
    basis = basis_of(y, window, exposure(y, window))
    weighted = basis * patch.used[None]
    prior = jnp.asarray([1 / s**2 for s in _LIGHT_SIGMA], basis.dtype)
    gram = weighted @ basis.T + jnp.diag(prior)
    return eliminate(gram, (weighted @ patch.levels / patch.contrast)[:, None])[:, 0]


def prior_of(y: Unknowns, window: Window) -> tuple[Float[Array, " p"], Float[Array, "p n"]]:
    """What is expected of motion, lens and light, in standard deviations, and its slopes."""
    patch, dtype = window.patch, y.light.dtype
    sigmas = jnp.asarray([_LENS_SIGMA_PX2, *_LIGHT_SIGMA], dtype)
    sigmas = jnp.concatenate([jnp.full(2, 1, dtype) * patch.motion_sigma_px, sigmas])
    off = jnp.concatenate([y.motion_px - patch.motion_px, (y.lens_px2 - LENS_PX2)[None], y.light])
    slopes = jnp.eye(UNKNOWNS, dtype=y.light.dtype)[8:] / sigmas[:, None]
    return off / sigmas, slopes
