"""The cost of sightings that may be wrong, and how far the parts of a recording disagree.

A sighting whose corners lie further off than noise explains counts less the further off it is: its
cost grows as the logarithm, so that wrong sightings hardly pull.

A lens that is a little off, a marker that is not flat and wheels that slip err alike for seconds.
Residuals look like noise all the same, and sigmas from them alone are too small: parts of the
recording then disagree by more than their residuals explain.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

# A sighting has eight coordinates; with Gaussian noise one sighting in a thousand is further off.
FAR = float(stats.chi2.ppf(0.999, 8))


def sighting_cost(chi2: Float[Array | np.ndarray, " N"]) -> Float[Array, " N"]:
    """The chi-square of each sighting up to `FAR`, then a logarithm, continued smoothly."""
    return jnp.where(chi2 < FAR, chi2, FAR * (1 + jnp.log(jnp.maximum(chi2, FAR) / FAR)))


def sighting_weight(chi2: Float[Array | np.ndarray, " N"]) -> Float[Array, " N"]:
    """The weight of each sighting with this cost: 1 up to `FAR`, beyond it `FAR` / chi2."""
    return FAR / jnp.maximum(chi2, FAR)


def variance_inflation(
    scores: Float[np.ndarray, "B p"],
    covariance: Float[np.ndarray, "p p"],
    unknowns: int,
    noticed: float,
) -> float:
    """The factor of the variances over those from independent noise; 1 if it is not noticed.

    Args:
        scores: gradient of half the cost of each part by the shared unknowns, the others
            eliminated.
        covariance: of the shared unknowns, from the residuals; zero for those that are fixed.
        unknowns: how many are not.
        noticed: a smaller factor may come from so many parts by chance.

    Source: Liang, Zeger (1986), "Longitudinal data analysis using generalized linear models": the
    robust variance, of which this is the mean over all unknowns.
    """
    parts = len(scores)
    spread = np.einsum("bi,ij,bj->", scores, covariance, scores) * parts / max(parts - 1, 1)
    ratio = float(spread) / max(unknowns, 1)
    return ratio if ratio > noticed else 1.0
