"""What tuning reaches, as tables: `python benchmarks/bench_tuning.py [filter] [controller] [rivals]
[recordings] [cost] [--out DIR]`, all of them by default.

`filter`, `controller` and `recordings` run the commands that a person runs, and read their
summaries. An interrupted one goes on where it was. `rivals` holds BFGS with gradients against
Nelder-Mead and CMA-ES on one loss; `cost` holds gradients against forward passes.
"""

import argparse
import functools
import itertools
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

TEST_SEEDS = 500
TAGSLAM = Path("../shared/data/tagslam")
Q = {"motion.acceleration_density": [0.01, 0.01, 0.09]}
R_SIGMA = {"motion.odometry_sigma": [0.01, 0.01, 0.01], "corner_sigma_px": 1.0}
ROUNDS = 15


def main() -> None:
    """Print the tables that are asked for."""
    sections: dict[str, Callable[[Path], None]] = {
        "filter": filter_table,
        "controller": controller_table,
        "rivals": rivals_table,
        "recordings": recordings_table,
        "cost": cost_table,
    }
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sections", nargs="*", help=", ".join(sections))
    parser.add_argument("--out", type=Path, default=Path("out/bench_tuning"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.sections or sections:
        print(f"\n## {name}\n", flush=True)
        sections[name](args.out)


def tuned(*arguments: str, out: Path) -> dict[str, Any]:
    """The summary of `jaxnav tune ...`."""
    command = [sys.executable, "-c", "import sys; from jaxnav.cli import main; sys.exit(main())"]
    subprocess.run([*command, "tune", *arguments, "--out", str(out), "--headless"], check=True)
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


def wrong_by(q: float, r: float) -> dict[str, Any]:
    """Q and R as covariances, so many times what they are by default."""
    sigmas = {name: np.multiply(value, np.sqrt(r)).tolist() for name, value in R_SIGMA.items()}
    return {name: np.multiply(value, q).tolist() for name, value in Q.items()} | sigmas


def filter_table(out: Path) -> None:
    """From Q and R wrong by 10, without truth; and what truth would have made of it."""
    rows = []
    starts = [(1.0, 1.0, loss) for loss in ("likelihood", "score", "error")]
    starts += [(q, r, "likelihood") for q, r in itertools.product((10.0, 0.1), repeat=2)]
    for q, r, loss in starts:
        name = f"filter_{loss}_{q:g}_{r:g}"
        params = out / f"{name}.yaml"
        params.write_text(json.dumps({"parameters": wrong_by(q, r)}))
        summary = tuned(
            *("filter", "--loss", loss, "--params", str(params)),
            *("--test-seeds", str(TEST_SEEDS)),
            out=out / name,
        )
        (judged,) = summary["test"].values()
        rows.append((q, r, loss, judged["before"], judged["after"], summary))
    known = [judged for row in rows for judged in row[3:5]]
    best = min(judged["position_rmse_m"]["value"] for judged in known)
    low, high = known[0]["anees_consistent"]
    print(f"{TEST_SEEDS} drives never seen; ANEES of {low:.2f} to {high:.2f} is consistent\n")
    print("| Q | R | loss | RMSE before cm | after cm | against the best | ANEES before | after |")
    print("|---|---|---|---|---|---|---|---|")
    for q, r, loss, before, after, _ in rows:
        rmse = [100 * judged["position_rmse_m"]["value"] for judged in (before, after)]
        ends = [100 * end for end in after["position_rmse_m"]["interval"]]
        print(
            f"| x {q:g} | x {r:g} | {loss} | {rmse[0]:.2f} | {rmse[1]:.2f} ({ends[0]:.2f} to "
            f"{ends[1]:.2f}) | {rmse[1] / (100 * best) - 1:+.1%} | "
            f"{before['anees']['value']:.3g} | {after['anees']['value']:.2f} |"
        )


def controller_table(out: Path) -> None:
    """The gains that are shipped, and tuned ones."""
    summary = tuned("controller", "--test-seeds", str(TEST_SEEDS), out=out / "controller")
    print(f"{TEST_SEEDS} drives of each, never seen: shipped -> tuned\n")
    print("| scenario | loss | | time to the last waypoint s | success |\n|---|---|---|---|---|")
    for name, judged in summary["test"].items():
        was, now = judged["before"], judged["after"]
        change = now["loss"]["value"] / was["loss"]["value"] - 1
        low, high = now["loss"]["interval"]
        print(
            f"| {name} | {was['loss']['value']:.3f} -> {now['loss']['value']:.3f} "
            f"({low:.3f} to {high:.3f}) | {change:+.1%} | {was['time_s']['value']:.2f} -> "
            f"{now['time_s']['value']:.2f} | {was['success_rate']['value']:.1%} -> "
            f"{now['success_rate']['value']:.1%} |"
        )
    after = summary["parameters"]["after"]
    print("\n" + ", ".join(f"{name} {value:.4g}" for name, value in after.items()))


def recordings_table(out: Path) -> None:
    """The constant-velocity prior of a hand-held rig, one marker at a time."""
    learned = str(TAGSLAM / "test_5")
    summary = tuned(
        *("filter", learned, "--part", "0", "0.5", "--test", str(TAGSLAM / "test_7")),
        out=out / "recordings",
    )
    print("| never seen | median cm | RMSE cm | ANEES (6 dof) |\n|---|---|---|---|")
    for name, judged in summary["test"].items():
        cells = []
        for pick in (
            lambda j: 100 * j["position_median_m"],
            lambda j: 100 * j["position_rmse_m"]["value"],
            lambda j: j["anees"]["value"],
        ):
            cells.append(_change(pick(judged["before"]), pick(judged["after"])))
        print(f"| {name} | {' | '.join(cells)} |")


def _change(was: float | None, now: float | None) -> str:
    """A figure before and after; JSON's null is one that is no number."""
    told = ["no number" if value is None else f"{value:.3g}" for value in (was, now)]
    return " -> ".join(told) + (f" ({now / was - 1:+.1%})" if was and now else "")


def rivals_table(out: Path) -> None:
    """Rollouts until a loss is reached that BFGS has reached; a gradient counts as four."""
    import cma
    import jax
    import jax.numpy as jnp
    from scipy.optimize import minimize

    from jaxnav.experiments.tuning.descent import Smooth

    objective, batch, start = _filter_loss(seeds=32)
    soft = jnp.zeros((), start.dtype)
    value = jax.jit(lambda x: objective(x, batch, soft))
    descent = Smooth(objective)
    x, path, gained = start, [], np.inf
    while gained > 1e-3:  # anew where it has ended, as the command does
        state = descent.init(x, batch, soft)
        while not bool(state.over):
            state = descent.step(state, batch, soft)
            path.append(float(value(state.x)))
        gained, x = float(value(x)) - path[-1], state.x
    reached = path[-1]
    goals = {"the last loss": reached + 1e-4, "1e-2 above it": reached + 1e-2}
    print(f"{len(start)} parameters, {len(batch.items.recorded)} drives a rollout\n")
    # What a gradient has found is known when its four rollouts are done.
    traces: dict[str, list[float]] = {"BFGS": [x for loss in path for x in (*[np.inf] * 3, loss)]}

    def counted(name: str) -> Callable[[np.ndarray], float]:
        traces[name] = []

        def function(x: np.ndarray) -> float:
            traces[name].append(float(np.nan_to_num(value(jnp.asarray(x, start.dtype)), nan=1e9)))
            return traces[name][-1]

        return function

    origin, budget = np.asarray(start, float), 40 * len(path)
    options = {"maxfev": budget, "xatol": 1e-6, "fatol": 1e-8, "adaptive": True}
    minimize(counted("Nelder-Mead"), origin, method="Nelder-Mead", options=options)
    cma.fmin2(
        counted("CMA-ES"),
        origin,
        1.0,
        {"maxfevals": budget, "verbose": -9, "seed": 1, "tolfun": 1e-8},
    )
    print("| | rollouts to " + " | to ".join(goals) + " | best |\n|---|---|---|---|")
    for name, losses in traces.items():
        cells = []
        for goal in goals.values():
            hits = np.flatnonzero(np.array(losses) <= goal)
            cells.append(str(hits[0] + 1) if len(hits) else f"not in {len(losses)}")
        print(f"| {name} | {' | '.join(cells)} | {min(losses):.5f} |")


def cost_table(out: Path) -> None:
    """Gradient over forward pass, medians of interleaved runs: of as many drives as the commands
    take by default, and of half as many; through the same kind of program."""
    import jax
    import jax.numpy as jnp

    print(
        "| | drives | parameters | forward ms a drive | gradient ms | ratio |\n" + "|---" * 6 + "|"
    )
    for seeds in (32, 64):
        objective, batch, start = _filter_loss(seeds)
        at = jnp.zeros((), start.dtype)
        forward = jax.jit(
            lambda x, objective=objective, batch=batch, at=at: objective(x, batch, at)
        )
        gradient = jax.jit(jax.value_and_grad(forward))
        drives = len(batch.items.recorded)
        _print_cost(
            "filter",
            len(start),
            drives,
            functools.partial(forward, start),
            functools.partial(gradient, start),
        )

    from jaxnav.commands.simulate.arguments import TuneController
    from jaxnav.commands.tune.controller import closed_loop, gains_of

    args = TuneController(headless=True)
    loop = closed_loop(args, args.scenario)
    space = gains_of(args, loop.rollout.navigator)
    keys = jax.vmap(jax.random.key)(jnp.arange(args.seeds))
    _print_cost(
        "controller",
        len(space.start),
        args.seeds,
        lambda: loop.value(space.values(space.start), keys)[0],
        lambda: loop.value_and_grad(space.start, space, keys),
    )


def _print_cost(
    name: str,
    parameters: int,
    drives: int,
    forward: Callable[[], Any],
    gradient: Callable[[], Any],
) -> None:
    import jax

    seconds: list[list[float]] = [[], []]
    for round_ in range(1 + ROUNDS):  # the first one compiles
        for function, times in zip((forward, gradient), seconds, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(function())
            if round_:
                times.append(time.perf_counter() - begin)
    ratio = np.median(np.array(seconds[1]) / np.array(seconds[0]))
    told = " | ".join(f"{1e3 * np.median(times) / drives:.2f}" for times in seconds)
    print(f"| {name} | {drives} | {parameters} | {told} | {ratio:.2f} |", flush=True)


def _filter_loss(seeds: int) -> tuple[Any, Any, Any]:
    """The likelihood of drives, Q ten times too large and R ten times too small."""
    from jaxnav.commands.simulate.arguments import TuneFilter
    from jaxnav.files.configuration import configure

    configure(float64=False)
    import jax.numpy as jnp

    from jaxnav.commands.tune.data import read_data
    from jaxnav.commands.tune.filter import space_of
    from jaxnav.core.parameters import with_parameters
    from jaxnav.experiments.tuning.filter import FilterCost
    from jaxnav.experiments.tuning.objective import Objective

    args = TuneFilter(seeds=seeds, held_out_seeds=1, headless=True)
    data = read_data(args)
    values = {name: jnp.asarray(value) for name, value in wrong_by(10.0, 0.1).items()}
    space = space_of(args, with_parameters(data.navigator, values), data.learned)
    cost = FilterCost(data.navigator, space, "likelihood")
    right = space_of(args, data.navigator, data.learned)
    return Objective(cost), cost.batches(right.start, data.learned)[0], space.start


if __name__ == "__main__":
    main()
