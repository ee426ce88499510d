"""What the long run attacks: every loader, and every command that is given a file.

A command is written as it is typed; `{name}` is a file of `seeds`, `{out}` a folder that is new.
The first file named is the one that is damaged, unless another is marked by `{!name}`.
"""

import re
from dataclasses import dataclass

_RIGGED = "--rig {rig.yaml} --markers {markers.yaml}"
_ROS = f"--topics {{topics.yaml}} {_RIGGED} --vehicle {{vehicle.yaml}}"
_FROM = {
    "rig.yaml": "kalibr",
    "chain.yaml": "jaxnav",
    "info.yaml": "opencv",
    "opencv.yml": "ros",
    "photon.json": "ros",
    "layout.json": "jaxnav",
    "markers.yaml": "wpilib",
}
# Weight, and the command.
_LINES: list[tuple[float, str]] = [
    (3, "plot {drive.mcap} --out {out} --headless"),
    (1, "view {drive.mcap} --out {out}/view.rrd --headless"),
    (3, "replay {drive.mcap} --out {out} --headless --limit 60"),
    (2, "replay {drive.mcap} --selector mahalanobis --out {out} --headless --limit 60"),
    (1, "replay {drive.mcap} --corner-sigma-px 0.5 --record-anew --out {out} --headless"
        " --limit 60"),
    (1, "replay {drive.mcap} --images --out {out} --headless"),
    (2, "replay {decoded.npz} --out {out} --headless"),
    (1, "replay {decoded.npz} --one-at-a-time --out {out} --headless"),
    (1, "replay {seen.bag} " + _RIGGED + " --out {out} --headless"),
    (1, "replay {tagslam/tagslam.yaml/..} --out {out} --headless"),
    (1, "replay {ros.bag} " + _ROS + " --route {route.yaml} --out {out} --headless"),
    (1, "replay {ros.bag} --topics {!topics.yaml} --rig {rig.yaml} --markers {markers.yaml}"
        " --vehicle {vehicle.yaml} --route {route.yaml} --out {out} --headless"),
    (3, "calibrate odometry {eights.mcap} --out {out} --headless"),
    (1, "calibrate odometry {eights.mcap} --rig {!rig.yaml} --out {out} --headless"),
    (1, "calibrate odometry {eights.mcap} --vehicle {!vehicle.yaml} --out {out} --headless"),
    (1, "calibrate odometry {ros.bag} " + _ROS + " --out {out} --headless"),
    (3, "calibrate check {eights.mcap} --out {out}"),
    (1, "calibrate check {decoded.npz} --out {out}"),
    (1, "calibrate check {seen.bag} " + _RIGGED + " --out {out}"),
    (2, "calibrate markers {eights.mcap} --out {out}"),
    (1, "calibrate markers {decoded.npz} --marker-size-m 0.2 --out {out}"),
    (2, "calibrate rig {eights.mcap} --out {out}"),
    (1, "calibrate rig {decoded.npz} --out {out}"),
    (0.5, "calibrate intrinsics {images/1.png} --board {board.yaml} --out {out} --headless"),
    (0.5, "calibrate intrinsics {images} --board {!board.yaml} --out {out} --headless"),
    *((0.4, f"calibrate convert {{{name}}} --to {to} --out {{out}}/made.txt")
      for name, to in _FROM.items()),
    (1, "tune filter {drive.mcap} --out {out} --headless"),
    (1, "tune filter {decoded.npz} --out {out} --headless"),
    (1, "reliability {decoded.npz} --out {out} --headless"),
    *((0.4, f"doctor --{name} {{{name}.yaml}}") for name in ("rig", "markers", "vehicle", "route")),
    (1, "doctor --frame front={photo.png}"),
    (1, "locate {photo.png} --camera {opencv.yml} --marker-size-m 0.2 --out {out}/found.png"),
    (1, "locate {photo.png} --camera {!opencv.yml} --marker-size-m 0.2"),
    (1, "simulate --seeds 1 --json {kept.json} --resume --headless"),
    *((0.4, f"simulate --seeds 1 --headless --{name} {{{name}.yaml}}")
      for name in ("rig", "markers", "vehicle", "params")),
    *((0.4, f"demo --out {{out}} --headless --{name} {{{name}.yaml}}")
      for name in ("rig", "markers", "vehicle", "route", "params")),
    (0.4, "run --car replay --option drive={drive.mcap} --duration-s 0.2 --headless"),
    *((0.4, f"run --headless --duration-s 0.1 --{name} {{{name}.yaml}}")
      for name in ("rig", "markers", "vehicle", "route", "params")),
    (0.5, "study ambiguity {ambiguity.yaml} --out {out}/s.zarr --headless"),
    (0.5, "study drive {drive.yaml} --out {out}/s.zarr --headless"),
    *((0.5, f"plot {{study/s.zarr/{part}/..}} --out {{out}} --headless")
      for part in ("zarr.json", "done/zarr.json", "outcome/zarr.json", "outcome/c/0/0/0")),
]  # fmt: skip
_FILE = re.compile(r"\{(!?)([^}]+)\}")


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        line: as above; its name in messages and in kept cases.
        damaged: which of the seeds is changed, as a path below the seeds' folder.
        seeds: top-level names of all that it needs.
    """

    line: str
    weight: float
    damaged: str
    seeds: tuple[str, ...]

    @staticmethod
    def of(line: str, weight: float) -> "Command":
        """From a line as above."""
        named = [(mark, name) for mark, name in _FILE.findall(line) if name != "out"]
        marked = [name for mark, name in named if mark] or [named[0][1]]
        return Command(
            line,
            weight,
            marked[0].removesuffix("/.."),
            tuple(dict.fromkeys(name.split("/")[0] for _, name in named)),
        )

    def argv(self, folder: str, out: str, renamed: str | None = None) -> list[str]:
        """The words of the command line.

        Args:
            folder: where the seeds lie.
            renamed: what the damaged file is called, where it is not called as its seed.
        """

        def path(found: re.Match[str]) -> str:
            name = found[2]
            if name == "out":
                return out
            plain = name.removesuffix("/..")
            if plain != name:  # a file inside of what the command is given
                top = 2 if plain.startswith("study/") else 1
                return "/".join([folder, *plain.split("/")[:top]])
            if renamed is not None and plain == self.damaged:
                *before, _ = plain.split("/")
                return "/".join([folder, *before, renamed])
            return f"{folder}/{plain}"

        return [_FILE.sub(path, word) for word in self.line.split()]


COMMANDS = [Command.of(line, weight) for weight, line in _LINES]
