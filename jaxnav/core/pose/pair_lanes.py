"""Both poses of many markers at once: `ippe_square` and `solve_marker` with every scalar an array.

A lane is one pose of one marker. Lanes do not wait for each other: one that has converged stays,
and after a few steps the few that have not are gathered and refined alone. A lane's result
depends neither on its neighbours nor on how many there are.

Unknowns are the marker's turn about its own centre, the image of that centre, and half a side over
depth; the marker's size only scales the result. Corners are taken relative to their mean, which
keeps float32's digits for small markers.

Two properties of XLA on a CPU shape the code. It computes a value anew in every kernel that uses
it, unless that value is a quotient or a root: so values that are used often end in one. And arrays
a multiple of 4096 bytes apart evict each other from the first-level cache: so blocks have odd
lengths. `benchmarks/README-pose.md` has the figures.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxnav.core.linalg.levenberg_marquardt import LanewiseSolver
from jaxnav.core.models.geometry import EVEN_FOUR_SQUARES
from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.pose.ippe import PosePair

_SIGNS = [(int(a), int(b)) for a, b, _ in CORNER_SIGNS]
_FIRST_STEPS = 2  # for all lanes; most need no more
_ROUNDS, _FIRST_ROUND = 5, 4  # lanes not done get 4, 8, 16, 32, 64 further steps

Lane = Float[Array, "*lanes"]


class Marks(NamedTuple):
    """The corners of every lane, relative to their mean."""

    x: tuple[Lane, ...]  # four corners
    y: tuple[Lane, ...]
    mean: tuple[Lane, Lane]
    unit: Lane  # unit of the residuals: about half a side in the image
    usable: Bool[Array, "*lanes"]


class Poses(NamedTuple):
    """The unknowns of every lane."""

    wxyz: tuple[Lane, Lane, Lane, Lane]  # of any length
    center: tuple[Lane, Lane]  # image of the marker's centre, relative to the corners' mean
    scale: Lane  # half a side over the centre's depth


class SolverState(NamedTuple):
    """The state of Levenberg-Marquardt in every lane."""

    cost: Lane  # sum of squares in units; inf where a corner is behind the camera
    damping: Lane
    promised: Lane  # gain that the model promised for the last accepted step
    done: Bool[Array, "*lanes"]


class _State(eqx.Module):
    trace: SolverState
    left: Int[Array, ""]  # number of steps left


def marks(corners_n: Float[Array, "4 2 *lanes"]) -> Marks:
    """The `Marks` of corners (4, 2, *lanes), with zeros for those that are not finite."""
    usable = jnp.all(jnp.isfinite(corners_n), axis=(0, 1))
    corners = jnp.where(usable[None, None], corners_n, 0)
    x, y = (tuple(corners[i, k] for i in range(4)) for k in (0, 1))
    mean_x, mean_y = (x[0] + x[1] + x[2] + x[3]) / 4, (y[0] + y[1] + y[2] + y[3]) / 4
    x, y = tuple(c - mean_x for c in x), tuple(c - mean_y for c in y)
    spread = sum((c * c for c in x + y), jnp.zeros_like(mean_x))
    unit = jnp.sqrt(jnp.where(spread > 0, spread / 8, 1))
    return Marks(x, y, (mean_x, mean_y), unit, usable)


def closed_form(seen: Marks) -> tuple[Poses, Poses]:
    """Both poses of every lane's marker. Source: see `ippe_square`, of which this is a copy."""
    x, y, (mean_x, mean_y), dtype = seen.x, seen.y, seen.mean, seen.unit.dtype
    # The homography at the centre.
    across, along, twist = (
        tuple(c[0] * s[0] + c[1] * s[1] + c[2] * s[2] + c[3] * s[3] for c in (x, y))
        for s in ((1, 1, -1, -1), (-1, 1, 1, -1), (1, -1, 1, -1))
    )
    determinant = across[0] * along[1] - across[1] * along[0]
    floor = 8 * jnp.finfo(dtype).eps * seen.unit * seen.unit + jnp.finfo(dtype).tiny
    safe = jnp.abs(determinant) > floor
    divisor = jnp.where(safe, determinant, 1)
    g = jnp.where(safe, twist[0] * along[1] - twist[1] * along[0], 0) / divisor
    h = jnp.where(safe, across[0] * twist[1] - across[1] * twist[0], 0) / divisor
    weight = [1 + a * g + b * h for a, b in _SIGNS]
    whole = weight[0] + weight[1] + weight[2] + weight[3]
    center_x, center_y = (sum(c[i] * weight[i] for i in range(4)) / whole for c in (x, y))
    jacobian = [
        [
            sum(_SIGNS[i][k] * c[i] * weight[i] for i in range(4)) / whole - center * slope
            for k, slope in ((0, g), (1, h))
        ]
        for c, center in ((x, center_x), (y, center_y))
    ]

    # As a camera that looks straight at the centre would see it: det(p) is the ray's length.
    ray_x, ray_y = center_x + mean_x, center_y + mean_y
    length = jnp.sqrt(1 + ray_x * ray_x + ray_y * ray_y)
    rx, ry, rz = ray_x / length, ray_y / length, 1 / length
    lean = 1 + rz
    sight = ((1 - rx * rx / lean, -rx * ry / lean, -rx), (-rx * ry / lean, 1 - ry * ry / lean, -ry))
    p00, p01 = (sight[k][0] - ray_x * sight[k][2] for k in (0, 1))
    p10, p11 = (sight[k][1] - ray_y * sight[k][2] for k in (0, 1))
    a, b = ((p11 * jacobian[0][k] - p01 * jacobian[1][k]) / length for k in (0, 1))
    c, d = ((p00 * jacobian[1][k] - p10 * jacobian[0][k]) / length for k in (0, 1))

    # Its two rotations.
    s0, s1, d0, d1 = (a + d) / 2, (c - b) / 2, (a - d) / 2, (c + b) / 2
    gamma = jnp.sqrt(s0 * s0 + s1 * s1) + jnp.sqrt(d0 * d0 + d1 * d1)
    gamma = jnp.where(gamma > 0, gamma, 1)
    p, q = 4 * (s0 * d0 + s1 * d1), 4 * (s0 * d1 - s1 * d0)
    larger = jnp.sqrt((jnp.sqrt(p * p + q * q) + jnp.abs(p)) / 2)
    smaller = -q / jnp.where(larger > 0, 2 * larger, 1)
    tilt = jnp.where(p >= 0, smaller, larger), jnp.where(p >= 0, larger, smaller)

    def pose(sign: int) -> Poses:
        t0, t1 = sign * tilt[0], sign * tilt[1]
        third = (rx, ry, rz)
        axis_x = [(sight[0][k] * a + sight[1][k] * c + third[k] * t0) / gamma for k in range(3)]
        axis_y = [(sight[0][k] * b + sight[1][k] * d + third[k] * t1) / gamma for k in range(3)]
        # Depth: least squares of (R p + t)_xy - u (R p + t)_z, in half sides.
        ax, ay, az = axis_x
        bx, by, bz = axis_y
        moment, offset_x, offset_y = jnp.zeros_like(g), jnp.zeros_like(g), jnp.zeros_like(g)
        for i, (sa, sb) in enumerate(_SIGNS):
            turned_z = sa * az + sb * bz
            defect_x = (x[i] + mean_x) * turned_z - (sa * ax + sb * bx)
            defect_y = (y[i] + mean_y) * turned_z - (sa * ay + sb * by)
            moment = moment - x[i] * defect_x - y[i] * defect_y
            offset_x, offset_y = offset_x + defect_x / 4, offset_y + defect_y / 4
        on_sight = 1 / gamma
        depth = moment / (8 * seen.unit * seen.unit)
        plausible = (depth > on_sight / 2) & (depth < on_sight * 2)
        depth = jnp.where(plausible, depth, on_sight)
        center = (
            jnp.where(plausible, offset_x, center_x * depth) / depth,
            jnp.where(plausible, offset_y, center_y * depth) / depth,
        )
        return Poses(_quaternion(axis_x, axis_y), center, 1 / depth)

    return pose(1), pose(-1)


def _quaternion(axis_x: list[Lane], axis_y: list[Lane]) -> tuple[Lane, Lane, Lane, Lane]:
    """(w, x, y, z) of the rotation with these columns. Source: see `rotation_from_matrix`."""
    (m00, m10, m20), (m01, m11, m21) = axis_x, axis_y
    m02, m12, m22 = m10 * m21 - m20 * m11, m20 * m01 - m00 * m21, m00 * m11 - m10 * m01
    rows = [
        (1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01),
        (m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20),
        (m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12),
        (m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22),
    ]
    four_squares = [rows[k][k] for k in range(4)]
    enough = functools.reduce(jnp.maximum, four_squares) - EVEN_FOUR_SQUARES
    (w, x, y, z), square = rows[3], four_squares[3]
    for k in (2, 1, 0):
        first = four_squares[k] >= enough
        square = jnp.where(first, four_squares[k], square)
        w, x, y, z = (
            jnp.where(first, new, old) for new, old in zip(rows[k], (w, x, y, z), strict=True)
        )
    length = 2 * jnp.sqrt(square)  # row i is 4 q_i q
    return w / length, x / length, y / length, z / length


def _axes(pose: Poses) -> list[tuple[Lane, Lane, Lane]]:
    """The columns of the rotation matrix."""
    w, x, y, z = pose.wxyz
    squares = w * w + x * x + y * y + z * z
    columns = [
        (w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z),
    ]
    return [(a / squares, b / squares, c / squares) for a, b, c in columns]


class _Corner(NamedTuple):
    """One coordinate k (x: 0, y: 1) of one projected corner, in normalised units."""

    k: int
    signs: tuple[int, int]
    residual: Lane
    per_shift: Lane  # derivative by a shift of one half side along k
    along: list[Lane]  # derivatives by moving the corner half a side along the marker's x, y, z
    depth: Lane  # over the centre's


def _corners(pose: Poses, seen: Marks) -> list[_Corner]:
    a, b, n = _axes(pose)
    s, corners = pose.scale, []
    for i, (sa, sb) in enumerate(_SIGNS):
        nearer = s * (sa * a[2] + sb * b[2])
        depth = 1 + nearer
        for k, coordinate in enumerate((seen.x, seen.y)):
            u = coordinate[i]
            shift = s * (sa * a[k] + sb * b[k]) - (seen.mean[k] + u) * nearer
            r = (pose.center[k] - u + shift) / depth
            projected = seen.mean[k] + u + r
            along = [s * (axis[k] - projected * axis[2]) / depth for axis in (a, b, n)]
            corners.append(_Corner(k, (sa, sb), r, s / depth, along, depth))
    return corners


def _cost(pose: Poses, seen: Marks) -> Lane:
    """Sum of squared residuals in units; inf with a corner in or behind the camera's plane."""
    corners = _corners(pose, seen)
    total = sum((c.residual * c.residual for c in corners), jnp.zeros_like(pose.scale))
    nearest = jnp.minimum(
        jnp.minimum(corners[0].depth, corners[2].depth),
        jnp.minimum(corners[4].depth, corners[6].depth),
    )
    in_front = (nearest > 1e-3) & (pose.scale > 0)
    return jnp.where(in_front, total, jnp.inf) / (seen.unit * seen.unit)


def residuals(pose: Poses, seen: Marks) -> list[Lane]:
    """Eight residuals of every lane, in units."""
    return [corner.residual / seen.unit for corner in _corners(pose, seen)]


def _normal_equations(pose: Poses, seen: Marks) -> tuple[list[Lane], dict[tuple[int, int], Lane]]:
    """J'r and the lower J'J by: centre (x, y; in half sides), log of the scale, turn z, x, y.

    A corner sits at sa, sb half sides: the scale moves it by (sa, sb, 0), turns by (-sb, sa, 0),
    (0, 0, sb), (0, 0, -sa). As sa^2 = sb^2 = 1 many of the sums are the same.
    """
    corners, zero = _corners(pose, seen), jnp.zeros_like(pose.scale)
    squared = seen.unit * seen.unit

    def total(term: Callable[..., Lane], only: int | None = None) -> Lane:
        terms = [term(c, *c.signs, *c.along) for c in corners if only in (None, c.k)]
        return sum(terms, zero) / squared

    gradient = [total(lambda c, sa, sb, a, b, n: c.per_shift * c.residual, k) for k in (0, 1)]
    gradient += [
        total(lambda c, sa, sb, a, b, n: c.residual * (sa * a + sb * b)),
        total(lambda c, sa, sb, a, b, n: c.residual * (sa * b - sb * a)),
        total(lambda c, sa, sb, a, b, n: c.residual * (sb * n)),
        total(lambda c, sa, sb, a, b, n: -c.residual * (sa * n)),
    ]
    lower: dict[tuple[int, int], Lane] = {}
    for k in (0, 1):
        lower[k, k] = total(lambda c, sa, sb, a, b, n: c.per_shift * c.per_shift, k)
        lower[2, k] = total(lambda c, sa, sb, a, b, n: c.per_shift * (sa * a + sb * b), k)
        lower[3, k] = total(lambda c, sa, sb, a, b, n: c.per_shift * (sa * b - sb * a), k)
        lower[4, k] = total(lambda c, sa, sb, a, b, n: c.per_shift * (sb * n), k)
        lower[5, k] = total(lambda c, sa, sb, a, b, n: -c.per_shift * (sa * n), k)
    mean = total(lambda c, sa, sb, a, b, n: a * a + b * b)
    skewed = total(lambda c, sa, sb, a, b, n: 2 * sa * sb * a * b)
    lower[2, 2], lower[3, 3] = mean + skewed, mean - skewed
    lower[3, 2] = total(lambda c, sa, sb, a, b, n: sa * sb * (b * b - a * a))
    lower[4, 2] = total(lambda c, sa, sb, a, b, n: n * (sa * sb * a + b))
    lower[5, 2] = total(lambda c, sa, sb, a, b, n: -n * (a + sa * sb * b))
    lower[4, 3] = total(lambda c, sa, sb, a, b, n: n * (sa * sb * b - a))
    lower[5, 3] = total(lambda c, sa, sb, a, b, n: n * (sa * sb * a - b))
    lower[4, 4] = lower[5, 5] = total(lambda c, sa, sb, a, b, n: n * n)
    lower[5, 4] = total(lambda c, sa, sb, a, b, n: -sa * sb * n * n)
    return gradient, lower


def _solve(A: dict[tuple[int, int], Lane], damping: Lane, b: list[Lane]) -> list[Lane]:
    """(A + damping I)^-1 b by Cholesky; entries that `A` lacks are zero. NaN if not positive."""
    n, L = len(b), dict[tuple[int, int], Lane]()
    for j in range(n):
        earlier = [k for k in range(j) if (j, k) in L]
        L[j, j] = jnp.sqrt(A[j, j] + damping - sum(L[j, k] * L[j, k] for k in earlier))
        for i in range(j + 1, n):
            if (i, j) in A:
                known = sum(L[i, k] * L[j, k] for k in earlier if (i, k) in L)
                L[i, j] = (A[i, j] - known) / L[j, j]
    forward: list[Lane] = []
    for i in range(n):
        known = sum(L[i, k] * forward[k] for k in range(i) if (i, k) in L)
        forward.append((b[i] - known) / L[i, i])
    x = list(forward)
    for i in reversed(range(n)):
        known = sum(L[k, i] * x[k] for k in range(i + 1, n) if (k, i) in L)
        x[i] = (forward[i] - known) / L[i, i]
    return x


def _moved(pose: Poses, move: list[Lane]) -> Poses:
    """The pose after a move: the turn is that of the quaternion (1, turn / 2), normalised."""
    w, x, y, z = pose.wxyz
    hx, hy, hz = move[4] / 2, move[5] / 2, move[3] / 2
    shrink = jax.lax.rsqrt(1 + hx * hx + hy * hy + hz * hz)
    wxyz = (
        (w - x * hx - y * hy - z * hz) * shrink,
        (x + w * hx + y * hz - z * hy) * shrink,
        (y + w * hy + z * hx - x * hz) * shrink,
        (z + w * hz + x * hy - y * hx) * shrink,
    )
    s = pose.scale
    return Poses(
        wxyz, (pose.center[0] + s * move[0], pose.center[1] + s * move[1]), s + s * move[2]
    )


class LaneLM(LanewiseSolver):
    """Levenberg-Marquardt on every lane by itself, for `optimistix.least_squares`.

    `y` is the `Poses`, `args` the `Marks`; `options` has the `trace` to go on from and how many
    `steps` to take at most. It stops when every lane is done: when what is left to gain
    is less than `rtol * cost + atol`. That is what the model promises for this step, or, where
    steps succeed and promise a fraction q of the one before, the rest q + q^2 + ... of the series.

    Source: Madsen, Nielsen, Tingleff (2004), "Methods for non-linear least squares problems",
    section 3.2, with bounded factors for the damping.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _State:
        """The trace of an earlier search, with which this one continues."""
        return _State(options["trace"], options["steps"])

    def step(
        self, fn: Any, y: Poses, args: Marks, options: Any, state: _State, tags: Any
    ) -> tuple[Poses, _State, PyTree]:
        """Try one damped step in every lane that is not done."""
        cost, damping, before, done = state.trace
        gradient, information = _normal_equations(y, args)
        move = _solve(information, damping, [-g for g in gradient])
        promised = sum(m * (damping * m - g) for m, g in zip(move, gradient, strict=True))
        trial = _moved(y, move)
        trial_cost = _cost(trial, args)
        # A step beyond four times the distance ends where the cost is flat.
        accept = (trial_cost < cost) & (move[2] > -0.75) & ~done
        gained = (cost - trial_cost) / jnp.where(promised > 0, promised, 1)
        least = jnp.finfo(cost.dtype).eps
        calmer = jnp.where(gained > 0.75, damping / 10, damping)
        calmer = jnp.where(gained < 0.25, 4 * damping + 1e-3, calmer)
        stiffer = jnp.maximum(8 * damping, 1e-2)
        fraction = jnp.minimum(promised / before, 0.99)
        to_come = jnp.where(accept, promised * fraction / (1 - fraction), promised)
        exhausted = (to_come <= self.rtol * cost + self.atol) | (damping > 1e9)
        trace = SolverState(
            cost=jnp.where(accept, trial_cost, cost),
            damping=jnp.where(accept, jnp.maximum(calmer, least), stiffer),
            promised=jnp.where(accept, promised, before),
            done=done | exhausted,
        )
        y = jax.tree.map(lambda new, old: jnp.where(accept, new, old), trial, y)
        return y, _State(trace, state.left - 1), None

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: _State, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether all lanes are done, or no step is left."""
        over = jnp.all(state.trace.done) | (state.left <= 0)
        return over, cast(optx.RESULTS, optx.RESULTS.successful)


def _improve(
    pose: Poses, seen: Marks, trace: SolverState, steps: Int[Array, ""] | int
) -> tuple[Poses, SolverState]:
    """Take at most `steps` steps of Levenberg-Marquardt in every lane."""
    # Relative to the cost and, in hundredths of the marker's spread, as for a single marker.
    tolerance = 1e-12 if seen.unit.dtype == jnp.float64 else 1e-6
    solution: optx.Solution = optx.least_squares(
        lambda y, args: residuals(y, args),
        LaneLM(rtol=tolerance, atol=tolerance * 8 / 100**2),
        pose,
        args=seen,
        options={"trace": trace, "steps": jnp.asarray(steps)},
        max_steps=None,
        throw=False,
    )
    return solution.value, solution.state.trace


def _begun(start: Poses, seen: Marks) -> tuple[Poses, SolverState]:
    """A start that is finite and in front of the camera, and its trace."""
    finite = seen.usable
    for number in jax.tree.leaves(start):
        finite = finite & jnp.isfinite(number)
    neutral = Poses((1.0, 0.0, 0.0, 0.0), (0.0, 0.0), 1.0)  # type: ignore[arg-type]
    start = jax.tree.map(lambda n, safe: jnp.where(finite, n, safe), start, neutral)
    a, b, _ = _axes(start)
    reach = jnp.abs(a[2]) + jnp.abs(b[2])
    scale = jnp.minimum(start.scale, 0.9 / jnp.maximum(reach, 0.1))
    start = start._replace(scale=scale)
    cost = _cost(start, seen)
    return start, SolverState(cost, jnp.full_like(cost, 1e-4), jnp.full_like(cost, 1e-30), ~finite)


def _stacked_pair(corners: Float[Array, "4 2 *lanes"]) -> tuple[Marks, Poses]:
    """The closed form: corners with a leading axis of 1, poses with a leading axis of 2."""
    seen = marks(corners)
    both = jax.tree.map(lambda *poses: jnp.stack(poses), *closed_form(seen))
    return jax.tree.map(lambda leaf: leaf[None], seen), both


def _result(pose: Poses, seen: Marks, cost: Lane, size_m: Float[Array, " B"]) -> PosePair:
    """The pair sorted by error, with the batch first. The leading axis of `pose` and `cost` is that
    of the two poses, followed by any number of axes of lanes."""
    usable = seen.usable[0] & jnp.isfinite(size_m)
    nothing = jnp.where(usable, 0, jnp.nan)[None]
    depth = size_m[None] / 2 / pose.scale
    length = jax.lax.rsqrt(sum(q * q for q in pose.wxyz))
    numbers = [q * length for q in pose.wxyz]
    numbers += [(m + c) * depth for m, c in zip(seen.mean, pose.center, strict=True)]
    numbers.append(depth)
    numbers.append(seen.unit * jnp.sqrt(cost / 8))
    swap = ~(numbers[-1][:1] <= numbers[-1][1:])
    table = jnp.stack([jnp.where(swap, n[::-1], n) + nothing for n in numbers])  # (8, 2, B)
    table = jnp.transpose(table, (2, 1, 0))
    return PosePair(jaxlie.SE3(table[..., :7]), table[..., 7])


def _in_blocks(corners_n: Float[Array, "B 4 2"], lanes: int) -> Float[Array, "blocks 4 2 lanes"]:
    """The corners in blocks with the lanes last, padded with zeros at the end."""
    count = -(-corners_n.shape[0] // lanes)
    padded = jnp.pad(corners_n, ((0, count * lanes - corners_n.shape[0]), (0, 0), (0, 0)))
    return jnp.transpose(padded.reshape(count, lanes, 4, 2), (0, 2, 3, 1))


def _block_lanes(batch: int, on_cpu: int, elsewhere: int) -> int:
    """The number of lanes in a block, a multiple of 16, bounded by the cache or the accelerator."""
    most = on_cpu if jax.default_backend() == "cpu" else elsewhere
    return min(most, -(-batch // 16) * 16)


def ippe_squares(corners_n: Float[Array, "B 4 2"], size_m: Float[Array, " B"]) -> PosePair:
    """`ippe_square` for a batch: (B, 4, 2) corners and (B,) sides give batch axes (B, 2)."""
    batch = corners_n.shape[0]
    if batch == 0:
        return _empty(corners_n.dtype)
    corners = _in_blocks(corners_n, _block_lanes(batch, 4112, 2**18))
    blocks, *_, lanes = corners.shape
    sizes = jnp.pad(size_m, (0, blocks * lanes - batch)).reshape(blocks, lanes)

    def block(both: tuple[Array, Array]) -> PosePair:
        seen, pair = _stacked_pair(both[0])
        return _result(pair, seen, _cost(pair, seen), both[1])

    pairs = jax.lax.map(block, (corners, sizes))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:batch], pairs)


def solve_pairs(corners_n: Float[Array, "B 4 2"], size_m: Float[Array, " B"]) -> PosePair:
    """Both poses of every marker, each at its local minimum: (B, 4, 2) and (B,) give (B, 2).

    Computes the result of `solve_marker` lane by lane, without derivatives. Corners that are not
    finite give NaN, corners that form no square's image finite but meaningless poses.
    """
    batch = corners_n.shape[0]
    if batch == 0:
        return _empty(corners_n.dtype)
    lanes = _block_lanes(batch, 2064, 2**18)

    def begin(corners: Array) -> tuple[Marks, Poses, SolverState]:
        seen, start = _stacked_pair(corners)
        start, trace = _begun(start, seen)
        return seen, *_improve(start, seen, trace, _FIRST_STEPS)

    seen, pose, trace = jax.lax.map(begin, _in_blocks(corners_n, lanes))
    pose, trace = _finished(pose, seen, trace)
    seen, pose, cost = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), (seen, pose, trace.cost))
    sizes = jnp.pad(size_m, (0, seen.unit.size - batch)).reshape(seen.unit.shape[1:])
    flat = jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0], -1), (seen, pose, cost))
    return jax.tree.map(
        lambda leaf: leaf[:batch], _result(flat[1], flat[0], flat[2], sizes.reshape(-1))
    )


def _finished(pose: Poses, seen: Marks, trace: SolverState) -> tuple[Poses, SolverState]:
    """Gather the lanes that are not done into blocks of their own, and refine them to the end.

    Args:
        pose, trace: (blocks, 2, lanes).
        seen: (blocks, 1, lanes).
    """
    shape = pose.scale.shape
    total, lanes = pose.scale.size, shape[-1]
    size = min(_block_lanes(total, 1040, 2**16), total)
    flat_seen = jax.tree.map(lambda leaf: leaf.reshape(-1), seen)
    room = -(-total // size) * size

    def one_round(carry: tuple[Poses, SolverState, Array]) -> tuple[Poses, SolverState, Array]:
        pose, trace, number = carry
        (left,) = jnp.nonzero(~trace.done, size=room, fill_value=total)
        count = jnp.sum(~trace.done)
        steps = _FIRST_ROUND * 2**number

        def one_block(carry: tuple[Array, Poses, SolverState]) -> tuple[Array, Poses, SolverState]:
            first, pose, trace = carry
            index = jax.lax.dynamic_slice(left, (first,), (size,))
            of_marker = index // (2 * lanes) * lanes + index % lanes
            here = jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), (pose, trace))
            there = jax.tree.map(lambda leaf: leaf.at[of_marker].get(mode="clip"), flat_seen)
            trace_here = here[1]._replace(done=here[1].done | (index >= total))
            better = _improve(here[0], there, trace_here, steps)
            pose, trace = jax.tree.map(
                lambda leaf, new: leaf.at[index].set(new, mode="drop", indices_are_sorted=True),
                (pose, trace),
                better,
            )
            return first + size, pose, trace

        _, pose, trace = jax.lax.while_loop(
            lambda carry: carry[0] < count, one_block, (jnp.asarray(0), pose, trace)
        )
        return pose, trace, number + 1

    def unfinished(carry: tuple[Poses, SolverState, Array]) -> Array:
        return (carry[2] < _ROUNDS) & ~jnp.all(carry[1].done)

    flat = jax.tree.map(lambda leaf: leaf.reshape(-1), (pose, trace))
    pose, trace, _ = jax.lax.while_loop(unfinished, one_round, (*flat, jnp.asarray(0)))
    return jax.tree.map(lambda leaf: leaf.reshape(shape), (pose, trace))


def _empty(dtype: jnp.dtype) -> PosePair:
    return PosePair(jaxlie.SE3(jnp.zeros((0, 2, 7), dtype)), jnp.zeros((0, 2), dtype))
