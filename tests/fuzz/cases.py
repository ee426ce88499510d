"""One case of the long run: what is damaged how, and what it is given to. A number tells it all."""

import shutil
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

import jax

from tests.fuzz import judge
from tests.fuzz.damage import NAMES, damage
from tests.fuzz.targets import COMMANDS, Command
from tests.helpers.loader_seeds import BINARY, STRUCTURED

LOADERS = STRUCTURED | BINARY
COMMAND_EVERY = 200  # cases: then commands and loaders take about the same time
# These take 10 to 500 ms, others 1 to 10: so none takes most of the time.
_SLOW = {"store": 0.01, "ROS": 0.05, "TagSLAM": 0.05, "bag": 0.1, "compressed bag": 0.1}
_WEIGHTS = [
    next((weight for slow, weight in _SLOW.items() if name.startswith(slow)), 1.0)
    for name in LOADERS
]
_RENAMED_SHARE = 0.08


@dataclass(frozen=True)
class Case:
    """A damaged file and what reads it.

    Attributes:
        target: the name of a loader, or the line of a command.
        folder: what it is given; of a loader with the folder in which the file lies.
        file: the damaged one, in the folder.
        renamed: what a command's file is called, None: as its seed.
    """

    target: str
    folder: Path
    file: Path
    renamed: str | None = None

    @property
    def command(self) -> Command | None:
        """The command; None of a loader."""
        return next((one for one in COMMANDS if one.line == self.target), None)

    def problem(self) -> str | None:
        """Run it; what is wrong with what came of it."""
        command = self.command
        if command is None:
            jax.config.update("jax_enable_x64", False)
            return judge.of_loader(LOADERS[self.target].load, self.file)
        out, elsewhere = (self.folder.parent / name for name in ("out", "elsewhere"))
        for made in (out, elsewhere):
            shutil.rmtree(made, ignore_errors=True)
            made.mkdir()
        argv = command.argv(str(self.folder), str(out), self.renamed)
        if "--json" in argv:  # is written to as well
            shutil.copy(argv[argv.index("--json") + 1], out / "kept.json")
            argv[argv.index("--json") + 1] = str(out / "kept.json")
        return judge.of_command(argv, self.folder, elsewhere)


def drawn(
    seed: int,
    number: int,
    seeds: Path,
    scratch: Path,
    only: str = "",
    command_every: int = COMMAND_EVERY,
) -> Case | None:
    """The case of a number: its files are written into `scratch`.

    Args:
        seeds: see `seeds.make`.
        only: None is drawn where the target's name does not hold this.
        command_every: so many cases is one of a command; 0: none is.
    """
    rng = Random(f"{seed} {number}")
    if command_every == 0 or number % command_every:
        name = rng.choices(list(LOADERS), _WEIGHTS)[0]
        return _of_loader(rng, name, scratch) if only in name else None
    command = rng.choices(COMMANDS, [one.weight for one in COMMANDS])[0]
    return _of_command(rng, command, seeds, scratch) if only in command.line else None


def undamaged(target: str, seeds: Path, scratch: Path) -> Case:
    """A target with its sound file."""
    command = next((one for one in COMMANDS if one.line == target), None)
    if command is None:
        folder, path, raw = _made(target, scratch)
        path.write_bytes(raw)
        return Case(target, folder, path)
    folder = scratch / "in"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name in command.seeds:
        copy = shutil.copytree if (seeds / name).is_dir() else shutil.copy
        copy(seeds / name, folder / name)
    return Case(target, folder, folder / command.damaged)


def _of_loader(rng: Random, name: str, scratch: Path) -> Case:
    folder, path, raw = _made(name, scratch)
    path.write_bytes(raw)
    damage(rng, path)
    return Case(name, folder, path)


def _of_command(rng: Random, command: Command, seeds: Path, scratch: Path) -> Case:
    case = undamaged(command.line, seeds, scratch)
    renamed = None
    if rng.random() < _RENAMED_SHARE and "/" not in command.damaged:
        renamed = f"{rng.choice(NAMES)}{case.file.suffix}"
        file = case.file.rename(case.file.with_name(renamed))
    else:
        file = case.file
    if renamed is None or rng.random() < 0.5:
        damage(rng, file)
    return Case(command.line, case.folder, file, renamed)


@cache
def _made(name: str, scratch: Path) -> tuple[Path, Path, bytes]:
    """A loader's folder, file and what that held, made once."""
    folder = scratch / "loaders" / str(list(LOADERS).index(name))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = LOADERS[name].make(folder)
    return folder, path, path.read_bytes()
