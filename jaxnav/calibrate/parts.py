"""How far the parts of a recording disagree.

A lens that is a little off, a marker that is not flat and wheels that slip err alike for seconds.
Residuals look like noise all the same, and sigmas from them alone are too small: parts of the
recording then disagree by more than their residuals explain.
"""

import numpy as np
from jaxtyping import Float


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
