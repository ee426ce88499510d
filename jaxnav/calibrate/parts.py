"""How far the parts of a recording disagree.

A lens that is a little off, a marker that is not flat and wheels that slip err alike for seconds.
Residuals look like noise all the same, and sigmas from them alone are too small: parts of the
recording then disagree by more than their residuals explain.
"""

import numpy as np
from jaxtyping import Float

_LEAST_LEFT = 1e-3  # of a direction that one part alone tells


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


def leveraged_inflation(
    information: Float[np.ndarray, "B p p"], scores: Float[np.ndarray, "B p"], noticed_sigmas: float
) -> float:
    """The factor of the variances where few parts tell much each; 1 if it is not noticed.

    A part draws the solution towards itself, by its share of the information, so its score is
    smaller than its error: each is divided by the root of what is left of it. Of independent noise
    the factor has the mean 1 exactly.

    Args:
        information: of the p shared unknowns from each part, the others eliminated, for noise of 1.
        scores: gradient of half the cost of each part by the shared unknowns, of residuals in
            units of their noise.
        noticed_sigmas: a factor not as many of its standard deviations above 1 may be chance.

    Source: Bell, McCaffrey (2002), "Bias reduction in standard errors for linear regression with
    multi-stage samples".
    """
    lower = np.linalg.cholesky(information.sum(axis=0))
    whitened = np.linalg.solve(lower, np.swapaxes(np.linalg.solve(lower, information), 1, 2))
    shares, axes = np.linalg.eigh(whitened)
    along = np.einsum("bij,bi->bj", axes, np.linalg.solve(lower, scores.T).T)
    squared = np.sum(along**2 / np.maximum(1 - shares, _LEAST_LEFT))
    count = information.shape[1]
    ratio = float(squared / count)
    chance = float(np.sqrt(2 * np.sum(shares**2)) / count)
    return ratio if ratio > 1 + noticed_sigmas * chance else 1.0
