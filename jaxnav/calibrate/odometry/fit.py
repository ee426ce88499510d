"""Levenberg-Marquardt over a whole course: nodes in a band, and a few parameters in a border.

The normal equations are block-tridiagonal in the nodes, with a border for the parameters. LAPACK's
banded Cholesky eliminates the nodes and leaves the Schur complement, the parameters' information:
the time grows with the length of the course, and not with its cube. optimistix has no solver of
this shape: its Levenberg-Marquardt would hold a dense Jacobian of some GiB.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from jaxnav.calibrate.odometry.model import NEXT, NODE, Blocks, Model
from jaxnav.core.linalg.levenberg_marquardt import adapted

_BELOW = NODE + NEXT - 1  # diagonals below the main one
_RTOL = 1e-9
_MOST_STEPS = 100
_PARTS = 20  # of a course, compared with each other
_HOLDS = 1e-9  # of a pose that nothing tells of, as the last of a stretch before its first view


@dataclass(frozen=True)
class Prior:
    """The prior of the parameters.

    Attributes:
        mean: (5,).
        information: (5,), one over the variance; 0 if nothing is known.
    """

    mean: Float[np.ndarray, " 5"]
    information: Float[np.ndarray, " 5"]


@dataclass(frozen=True)
class OdometryFit:
    """The most likely course.

    Attributes:
        nodes: (N + 1, 5), x_m, y_m, psi_rad, and the errors of readings in standard deviations.
        theta: (5,), see `model.NAMES`.
        information: (p, p), of the free parameters, with all nodes eliminated.
        blocks: the normal equations at this point.
        scores: (B, p), gradient of half the cost of each part of the course by the free parameters,
            with all nodes eliminated; they sum to zero.
        converged: true if no step lowers the cost any more.
    """

    nodes: Float[np.ndarray, "nodes 5"]
    theta: Float[np.ndarray, " 5"]
    information: Float[np.ndarray, "p p"]
    blocks: Blocks
    scores: Float[np.ndarray, "B p"]
    converged: bool


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
        free: (5,) bool, true for parameters to fit; the others stay.
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
        system = _System.of(blocks, theta, free, prior)
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
    system = _System.of(blocks, theta, free, prior)
    return OdometryFit(
        nodes, theta, system.reduced(), blocks, system.scores(blocks, free), converged
    )


@dataclass(frozen=True)
class _System:
    """Normal equations: a band (8, 5 N), a border (5 N, p), a corner (p, p) and the gradients."""

    band: np.ndarray
    border: np.ndarray
    corner: np.ndarray
    gradient_nodes: np.ndarray
    gradient_theta: np.ndarray

    @staticmethod
    def of(blocks: Blocks, theta: np.ndarray, free: np.ndarray, prior: Prior) -> "_System":
        """Assemble the normal equations from the blocks of the intervals and the prior."""
        H, g = blocks.information, blocks.gradient
        nodes = len(H) + 1
        own = np.zeros((nodes, NODE, NODE))
        own[:-1] += H[:, :NODE, :NODE]
        own[1:, :NEXT, :NEXT] += H[:, NODE : NODE + NEXT, NODE : NODE + NEXT]
        own[:, range(NODE), range(NODE)] += _HOLDS
        own[-1, range(NEXT, NODE), range(NEXT, NODE)] += 1.0  # the last node has no reading
        band = np.zeros((_BELOW + 1, nodes, NODE))
        for column in range(NODE):
            for row in range(column, NODE):
                band[row - column, :, column] += own[:, row, column]
            for row in range(NEXT):
                band[NODE + row - column, :-1, column] += H[:, NODE + row, column]
        border = np.zeros((nodes, NODE, int(free.sum())))
        border[:-1] += H[:, :NODE, NODE + NEXT :][:, :, free]
        border[1:, :NEXT] += H[:, NODE : NODE + NEXT, NODE + NEXT :][:, :, free]
        corner = H[:, NODE + NEXT :, NODE + NEXT :].sum(axis=0) + np.diag(prior.information)
        gradient = np.zeros((nodes, NODE))
        gradient[:-1] += g[:, :NODE]
        gradient[1:, :NEXT] += g[:, NODE : NODE + NEXT]
        of_theta = g[:, NODE + NEXT :].sum(axis=0) + prior.information * (theta - prior.mean)
        return _System(
            band.reshape(_BELOW + 1, -1),
            border.reshape(nodes * NODE, -1),
            corner[np.ix_(free, free)],
            gradient.reshape(-1),
            of_theta[free],
        )

    def reduced(self) -> np.ndarray:
        """(p, p): the parameters' information with the nodes eliminated; raises as `solved`."""
        return self._eliminated(0.0)[0]

    def scores(self, blocks: Blocks, free: np.ndarray) -> np.ndarray:
        """(B, p): the parameters' gradient by each part of the course, the nodes eliminated."""
        inner = self._eliminated(0.0)[1][:, :-1].reshape(-1, NODE, self.border.shape[1])
        g = blocks.gradient
        by_nodes = np.einsum("ni,nip->np", g[:, :NODE], inner[:-1])
        by_nodes += np.einsum("ni,nip->np", g[:, NODE : NODE + NEXT], inner[1:, :NEXT])
        scores = g[:, NODE + NEXT :][:, free] - by_nodes
        edges = np.linspace(0, len(scores), min(_PARTS, len(scores)), endpoint=False).astype(int)
        return np.add.reduceat(scores, edges, axis=0)

    def solved(self, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
        """The damped step of the nodes and of the parameters, and the decrease of the cost that the
        quadratic model promises.

        Raises:
            LinAlgError: the damped equations are not positive definite.
        """
        schur, inner = self._eliminated(damping)
        right = self.border.T @ inner[:, -1] - self.gradient_theta
        theta = cho_solve(cho_factor(schur), right) if len(right) else right
        nodes = -(inner[:, -1] + inner[:, :-1] @ theta)
        extra = damping * (
            np.sum(self.band[0] * nodes**2) + np.sum(np.diag(self.corner) * theta**2)
        )
        promised = extra - self.gradient_nodes @ nodes - self.gradient_theta @ theta
        return nodes.reshape(-1, NODE), theta, float(promised)

    def _eliminated(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """The Schur complement, and the band's inverse times border and gradient."""
        band, corner = self.band.copy(), self.corner.copy()
        if not all(np.isfinite(part).all() for part in (band, self.border, corner)):
            raise LinAlgError("the equations are not finite")
        band[0] *= 1 + damping
        corner[range(len(corner)), range(len(corner))] *= 1 + damping
        factor = cholesky_banded(band, lower=True, check_finite=False)
        right = np.column_stack([self.border, self.gradient_nodes])
        inner = cho_solve_banded((factor, True), right, check_finite=False)
        return corner - self.border.T @ inner[:, :-1], inner
