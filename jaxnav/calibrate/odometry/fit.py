"""Levenberg-Marquardt over a whole course: nodes in a band, and a few parameters in a border.

The normal equations are block-tridiagonal in the nodes, with a border for the parameters. LAPACK's
banded Cholesky eliminates the nodes and leaves the Schur complement, the parameters' information:
the time grows with the length of the course, and not with its cube. Neither optimistix nor scipy
has a solver of this shape: theirs hold a dense Jacobian of some GiB, or solve by iterations of
which the long chain of nodes takes thousands a step.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solveh_banded

from jaxnav.calibrate.odometry.model import NEXT, NODE, Blocks, Model
from jaxnav.core.linalg.levenberg_marquardt import adapted

_LOCAL = NODE + NEXT  # unknowns of the nodes in an interval: side by side, from the first one's on
_RTOL = 1e-9
_MOST_STEPS = 100
_PARTS = 20  # of a course, compared with each other
_HOLDS = 1e-9  # of a pose that nothing determines, as the last of a stretch before its first view


class Prior(NamedTuple):
    """The prior of the parameters."""

    mean: Float[np.ndarray, " 5"]
    information: Float[np.ndarray, " 5"]  # one over the variance; 0 if nothing is known


class OdometryFit(NamedTuple):
    """The most likely course."""

    # x_m, y_m, psi_rad, and the errors of readings in standard deviations
    nodes: Float[np.ndarray, "nodes 5"]
    theta: Float[np.ndarray, " 5"]  # see `model.NAMES`
    information: Float[np.ndarray, "p p"]  # of the free parameters, with all nodes eliminated
    blocks: Blocks  # the normal equations at this point
    # gradient of half the cost of each part of the course by the free parameters, with all nodes
    # eliminated; they sum to zero
    scores: Float[np.ndarray, "B p"]
    converged: bool  # true if no step lowers the cost any more


def fit(
    model: Model,
    nodes: Float[np.ndarray, "nodes 5"],
    theta: Float[np.ndarray, " 5"],
    free: Bool[np.ndarray, " 5"],
    prior: Prior,
    progress: Callable[[], object] = lambda: None,
) -> OdometryFit:
    """Search the nearest minimum from a start, with Nielsen's damping relative to the diagonal.

    Source: as `jaxnav.core.linalg.levenberg_marquardt`; the scaling is Marquardt's (1963).

    Args:
        free: true for parameters to fit; the others stay.
        progress: called at every evaluation.

    Raises:
        LinAlgError: the equations at the end can't be solved.
    """

    def evaluated(nodes: np.ndarray, theta: np.ndarray) -> tuple[float, Blocks]:
        progress()
        blocks = model.blocks(nodes, theta)
        off = theta - prior.mean
        return float(blocks.cost + np.sum(prior.information * off**2)), blocks

    cost, blocks = evaluated(nodes, theta)
    damping, growth, converged = 1e-3, 2.0, False
    for _ in range(_MOST_STEPS):
        system = System.from_blocks(blocks, theta, free, prior)
        try:
            step_nodes, step_theta, promised = system.solved(damping)
        except LinAlgError:
            damping *= 10.0
            continue
        new_nodes, new_theta = nodes + step_nodes, theta.copy()
        new_theta[free] += step_theta
        possible = bool(new_theta[0] > 0 and new_theta[3] > 0)
        new_cost, new_blocks = evaluated(new_nodes, new_theta) if possible else (np.inf, blocks)
        gained = (cost - new_cost) / max(promised, 1e-300)
        damping, growth = map(float, adapted(damping, growth, new_cost < cost, gained))
        converged = promised <= _RTOL * cost or damping > 1e12
        if new_cost < cost:
            nodes, theta, blocks, cost = new_nodes, new_theta, new_blocks, new_cost
        if converged:
            break
    system = System.from_blocks(blocks, theta, free, prior)
    information, inner = system.eliminated(0.0)
    return OdometryFit(
        nodes, theta, information, blocks, system.scores(blocks, free, inner), converged
    )


class System(NamedTuple):
    """Normal equations: a band (8, 5 N), a border (5 N, p), a corner (p, p) and the gradients."""

    band: Float[np.ndarray, "8 n"]  # lower: [row - column, column]
    border: Float[np.ndarray, "n p"]
    corner: Float[np.ndarray, "p p"]
    gradient_nodes: Float[np.ndarray, " n"]
    gradient_theta: Float[np.ndarray, " p"]

    @staticmethod
    def from_blocks(blocks: Blocks, theta: np.ndarray, free: np.ndarray, prior: Prior) -> "System":
        """Assemble the normal equations from the blocks of the intervals and the prior."""
        H, g = blocks.information, blocks.gradient
        first, n = NODE * np.arange(len(H))[:, None], NODE * (len(H) + 1)
        row, column = np.tril_indices(_LOCAL)
        at, nodes = (row - column) * n + first + column, (first + np.arange(_LOCAL)).ravel()

        def of_nodes(values: np.ndarray) -> np.ndarray:
            return np.bincount(nodes, values.ravel(), n)

        band: np.ndarray = np.bincount(at.ravel(), H[:, row, column].ravel(), _LOCAL * n)
        band = band.astype(float).reshape(_LOCAL, n)
        band[0] += _HOLDS
        band[0, NEXT - NODE :] += 1.0  # the last node has no reading
        border = [of_nodes(H[:, :_LOCAL, _LOCAL + p]) for p in np.flatnonzero(free)]
        corner = H[:, _LOCAL:, _LOCAL:].sum(axis=0) + np.diag(prior.information)
        of_theta = g[:, _LOCAL:].sum(axis=0) + prior.information * (theta - prior.mean)
        return System(
            band,
            np.reshape(border, (-1, n)).T,
            corner[np.ix_(free, free)],
            of_nodes(g[:, :_LOCAL]),
            of_theta[free],
        )

    def solved(self, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
        """The damped step of the nodes and of the parameters, and the decrease of the cost that the
        quadratic model promises.

        Raises:
            LinAlgError: the damped equations are not positive definite.
        """
        schur, inner = self.eliminated(damping)
        right = self.border.T @ inner[:, -1] - self.gradient_theta
        theta = cho_solve(cho_factor(schur), right) if len(right) else right
        nodes = -(inner[:, -1] + inner[:, :-1] @ theta)
        raised = np.sum(self.band[0] * nodes**2) + np.sum(np.diag(self.corner) * theta**2)
        promised = damping * raised - self.gradient_nodes @ nodes - self.gradient_theta @ theta
        return nodes.reshape(-1, NODE), theta, float(promised)

    def eliminated(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """The Schur complement, and the band's inverse times border and gradient."""
        if not all(np.isfinite(part).all() for part in self[:3]):
            raise LinAlgError("the equations are not finite")
        band, corner = self.band.copy(), self.corner.copy()
        band[0] *= 1 + damping
        corner[np.diag_indices(len(corner))] *= 1 + damping
        right = np.column_stack([self.border, self.gradient_nodes])
        inner = solveh_banded(band, right, lower=True, check_finite=False)
        return corner - self.border.T @ inner[:, :-1], inner

    def scores(
        self, blocks: Blocks, free: np.ndarray, inner: np.ndarray
    ) -> Float[np.ndarray, "B p"]:
        """The parameters' gradient by each part of the course, the nodes eliminated."""
        g, carried = blocks.gradient, inner[:, :-1].reshape(-1, NODE, self.border.shape[1])
        around = np.concatenate([carried[:-1], carried[1:, :NEXT]], axis=1)
        scores = g[:, _LOCAL:][:, free] - np.einsum("ni,nip->np", g[:, :_LOCAL], around)
        edges = np.linspace(0, len(scores), min(_PARTS, len(scores)), endpoint=False).astype(int)
        return np.add.reduceat(scores, edges, axis=0)
