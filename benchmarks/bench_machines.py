"""Hold what the estimator decides under one compiler against what it decides under others.

    python benchmarks/bench_machines.py [--cases drives test_7] [--jax FOLDER ...] [--only NAME ...]

Another machine, another JAX and other flags round differently. Each row is a process of its own,
since XLA reads its flags once, on the same input, held against the first row: in how many frames a
claim, `decided`, the chosen candidate and the hypotheses that live differ, and by how much poses.
`--jax` names folders of other versions: `pip install --no-deps --target FOLDER jax==V jaxlib==V`.
A recording is a folder of tagslam (see bench_recordings.py), every marker by itself.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from jaxnav.files import configuration

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("JAXNAV_DATA", ROOT.parent / "shared/data")) / "tagslam"
CLAIM = 1e-3  # a flip probability below it is a claim to be sure, as in bench_recordings.py
FRAMES, PERIOD_S = 60, 1 / 15
PLAIN = "--xla_llvm_disable_expensive_passes=true --xla_backend_optimization_level="
FUSED = "--xla_cpu_use_fusion_emitters="
# Under these the numbers that should be equal come out most differently.
CONTRARY = PLAIN + "1"
FLAGS = {
    "jaxnav's own": " ".join(f"--{name}={value}" for name, value in configuration.FLAGS.items()),
    "none": "",
    "level 0": PLAIN + "0",
    "level 1": CONTRARY,
    "level 2": PLAIN + "2",
    "fusion emitters on": FUSED + "true",
    "fusion emitters off": FUSED + "false",
    "SSE4.2, without FMA": "--xla_cpu_max_isa=SSE4_2",
}
Outcomes = dict[str, np.ndarray]


def make_drives() -> Outcomes:
    """What four drives of a car see: a step that tracks, a start that waits until it is decided,
    two cameras, and a start straight ahead of the marker, where left and right are equal."""
    import jax
    import jax.numpy as jnp

    from tests import worlds

    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    still = 15
    drives = {  # pose, m/s, rad, px, frames without motion
        "step": (worlds.FRONT_VIEW, 0.3, 0.1, 0.3, 0),
        "start": (worlds.START_VIEW, 0.3, 0.2, 0.5, still),
        "two cameras": (worlds.OVERLAP_VIEW, 0.1, -0.2, 0.3, 0),
        "straight ahead": ((0.0, -0.7, np.pi / 2), 0.2, 0.15, 0.0, still),
    }
    made: dict[str, list[np.ndarray]] = {}
    for seed, (start, speed_mps, steering_rad, sigma_px, stands) in enumerate(drives.values()):
        speeds = np.where(np.arange(FRAMES) < stands, 0.0, speed_mps)
        turn = np.cumsum(speeds) * PERIOD_S * np.tan(steering_rad) / 0.256
        psi_rad = start[2] + turn
        way = np.stack([np.cos(psi_rad), np.sin(psi_rad)]) * speeds * PERIOD_S
        x_m, y_m = np.cumsum(way, axis=1) + np.array(start[:2])[:, None]
        noise = sigma_px * np.random.default_rng(seed).standard_normal((FRAMES, 4, 1, 4, 2))
        poses = jax.vmap(lambda p: worlds.T_world_vehicle_from_planar(p))(
            jnp.asarray(np.stack([x_m, y_m, psi_rad], axis=1))
        )
        seen = jax.vmap(lambda T, px: worlds.observe(rig, markers, T, px))(
            poses, jnp.asarray(noise)
        )
        steering = np.full(FRAMES, steering_rad)
        rows = seen.corners_px, seen.visible, speeds, steering, np.full(FRAMES, PERIOD_S)
        for name, row in zip(
            ("corners_px", "visible", "speed_mps", "steering_rad", "dt_s"), rows, strict=True
        ):
            made.setdefault(name, []).append(np.asarray(row))
    return {"names": np.array(list(drives))} | {k: np.stack(v) for k, v in made.items()}


def run_drives(made: Outcomes) -> Outcomes:
    """The outcomes of every step, by drive and name."""
    import jax
    import jax.numpy as jnp

    from jaxnav.core.navigator import Navigator, State
    from jaxnav.core.pose.observation import Observation
    from tests import worlds

    navigator = Navigator(worlds.qcar_rig_by_hand(), worlds.paper_markers(), worlds.qcar_by_hand())

    def step(state: State, row: dict[str, jax.Array]) -> tuple[State, dict[str, jax.Array]]:
        state, out = navigator.step(state, Observation(**row))
        bank = state.belief.bank
        chosen = jnp.maximum(out.selected, 0)
        return state, {
            "flip": out.flip_probability,
            "decided": out.decided,
            "chosen": out.selected,
            "chosen pose": out.candidates.T_vehicle_world.wxyz_xyz[chosen],
            "lives": jnp.where(bank.initialised, bank.number, -1),
            "reported": out.hypothesis,
            "pose": out.T_world_vehicle.wxyz_xyz,
        }

    run = jax.jit(lambda drive: jax.lax.scan(step, navigator.init(), drive)[1])
    outcomes = {}
    for row, name in enumerate(made["names"]):
        fields = {key: jnp.asarray(made[key][row]) for key in made if key != "names"}
        told = run(fields)
        outcomes |= {f"{name}/{key}": np.asarray(value) for key, value in told.items()}
    return outcomes


def run_recording(name: str, frames: int) -> Outcomes:
    """The outcomes of a recording, (frames, markers)."""
    from jaxnav.core.filter.hypotheses import MultiHypothesis
    from jaxnav.recordings.other.recordings import read_recording
    from jaxnav.recordings.other.replay import replay

    recording = read_recording(DATA / name).first(frames)
    told = replay(recording, MultiHypothesis(), one_at_a_time=True)
    branch = told.branch
    return {
        f"{name}/flip": told.flip_probability,
        f"{name}/decided": told.decided,
        # -1: none; else whether it is the one nearest to the reference, of mostly two.
        f"{name}/chosen": np.where(told.seen, 2 * branch.wrong + branch.outlier, -1),
        f"{name}/pose": told.T_world_vehicle,
        f"{name}/seen": told.seen,
    }


def write_outcomes(drives: Path, out: Path, cases: list[str], frames: int) -> None:
    """What a process of the harness does."""
    outcomes: Outcomes = {}
    for case in cases:
        if case == "drives":
            with np.load(drives) as made:
                outcomes |= run_drives(dict(made))
        else:
            outcomes |= run_recording(case, frames)
    np.savez_compressed(out, **outcomes)


def outcomes_under(
    flags: str, drives: Path, cases: list[str], *, jax: Path | None = None, float32: bool = False,
    frames: int = 300,
) -> Outcomes:  # fmt: skip
    """The outcomes of a process with these flags, and with the JAX of a folder."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "outcomes.npz"
        paths = [*([str(jax)] if jax else []), str(ROOT), os.environ.get("PYTHONPATH", "")]
        env = os.environ | {
            "XLA_FLAGS": flags,
            "JAX_ENABLE_X64": str(int(not float32)),
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        }
        arguments = ["--cases", *cases, "--frames", str(frames), "--child", str(drives), str(out)]
        subprocess.run([sys.executable, __file__, *arguments], env=env, check=True)
        with np.load(out) as found:
            return dict(found)


def claims(outcomes: Outcomes, case: str) -> np.ndarray:
    """Frames (and markers) in which it says to be sure of the pose."""
    decided = outcomes[f"{case}/decided"] & outcomes.get(f"{case}/seen", True)
    return (outcomes[f"{case}/flip"] < CLAIM) & decided


def differences(one: Outcomes, other: Outcomes, case: str) -> dict[str, float]:
    """In how many frames two outcomes of a case differ, and by how much at most."""

    def count(key: str) -> int:
        unequal = one[f"{case}/{key}"] != other[f"{case}/{key}"]
        return int(np.sum(unequal.reshape(len(unequal), -1).any(axis=1)))

    claimed = claims(one, case), claims(other, case)
    seen = one.get(f"{case}/seen", np.ones_like(claimed[0]))
    poses = [out[f"{case}/pose"] for out in (one, other)]
    poses = [np.where(pose[..., :1] < 0, [-1] * 4 + [1] * 3, 1) * pose for pose in poses]
    flips = [np.maximum(out[f"{case}/flip"], 1e-9) for out in (one, other)]
    found = {
        "claims %": 100 * float(np.sum(claimed[1]) / np.sum(seen)),
        "claims": int(np.sum((claimed[0] != claimed[1]).reshape(len(seen), -1).any(axis=1))),
        "decided": count("decided"),
        "chosen": count("chosen"),
    }
    if f"{case}/lives" in one:
        found |= {"reported": count("reported"), "lives": count("lives")}
    off = np.abs(poses[0] - poses[1])[seen]
    return found | {
        "pose": float(np.max(off)),
        "factor of flip": float(np.exp(np.max(np.abs(np.log(flips[0] / flips[1]))))),
    }


def main() -> None:
    """Print a row for each case and each way to compile."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cases", nargs="+", default=["drives", "test_7"])
    parser.add_argument("--frames", type=int, default=300, help="of a recording, at most")
    parser.add_argument("--jax", nargs="*", type=Path, default=[], help="folders of other versions")
    parser.add_argument("--only", nargs="*", help="rows by name; by default all")
    parser.add_argument("--child", nargs=2, type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        write_outcomes(*args.child, args.cases, args.frames)
        return
    # (name, flags, folder of JAX, float32)
    rows = [(name, flags, None, False) for name, flags in FLAGS.items()]
    for jax in args.jax:
        rows += [(f"{jax.name}, {name}", FLAGS[name], jax, False) for name in ("none", "level 1")]
    rows += [(f"float32, {name}", FLAGS[name], None, True) for name in FLAGS]
    base: Outcomes = {}
    with tempfile.TemporaryDirectory() as folder:
        drives = Path(folder) / "drives.npz"
        np.savez_compressed(drives, **make_drives())
        for name, flags, jax, float32 in rows:
            if args.only and name not in args.only:
                continue
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            found = outcomes_under(
                flags, drives, args.cases, jax=jax, float32=float32, frames=args.frames
            )
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            base = base or found
            for case in dict.fromkeys(key.partition("/")[0] for key in found):
                row = differences(base, found, case)
                cells = [f"{key} {value:.4g}" for key, value in row.items()]
                print(f"| {name} | {case} | {' | '.join(cells)} |", flush=True)
            used_s = after.ru_utime - before.ru_utime
            print(f"  {used_s:.0f} s of CPU", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
