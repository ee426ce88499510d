"""Cases that failed once: a folder each, with the damaged file and what it was given to."""

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

from tests.fuzz import seeds
from tests.fuzz.cases import Case, undamaged
from tests.fuzz.targets import COMMANDS

FOLDER = Path(__file__).resolve().parents[1] / "data" / "fuzz"


def kept_cases() -> list[Path]:
    """All folders, in order."""
    return sorted(path.parent for path in FOLDER.glob("*/case.json"))


def keep(said: dict[str, Any], problem: str) -> Path:
    """Keep the damaged file of a case; the folder."""
    target = said["target"]
    words = re.sub(r"\{[^}]*\}|[^a-z]+", " ", target.lower()).split()[:3]
    if "place" not in said:  # a sound file
        return FOLDER
    _, file, renamed = said["place"]
    raw = Path(file).read_bytes()
    place = FOLDER / f"{'-'.join(words)}-{hashlib.blake2b(raw, digest_size=4).hexdigest()}"
    place.mkdir(parents=True, exist_ok=True)
    (place / "file").write_bytes(raw)
    story = {"target": target, "renamed": renamed, "problem": problem}
    (place / "case.json").write_text(json.dumps(story, indent=2) + "\n")
    return place


def replayed(place: Path, scratch: Path) -> str | None:
    """Run a kept case once more; what is wrong with what comes of it.

    Args:
        scratch: an empty folder.
    """
    story = json.loads((place / "case.json").read_text())
    sound = scratch / "seeds"
    sound.mkdir()
    command = next((one for one in COMMANDS if one.line == story["target"]), None)
    if command is not None:
        seeds.make(sound, set(command.seeds) - {command.damaged})
        (sound / command.damaged).parent.mkdir(exist_ok=True)
        shutil.copyfile(place / "file", sound / command.damaged)
    case = undamaged(story["target"], sound, scratch)
    file = case.file
    if story["renamed"] is not None:
        file = file.rename(file.with_name(story["renamed"]))
    shutil.copyfile(place / "file", file)
    return Case(case.target, case.folder, file, story["renamed"]).problem()
