"""A file altered in any way is read as something sound, or one line names file and key.

See docs/promises.md, Files can't hurt.

JAXNAV_FUZZ=3000 pytest tests/files/test_fuzz_loaders.py      # number of examples for each loader
"""

import dataclasses
import json
import os
import signal
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.commands.drive.plot import summary_lines
from jaxnav.drive.interfaces import Setup
from jaxnav.errors import BadInput
from jaxnav.files.reading import read_mapping
from jaxnav.recordings.drive_format import encode
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recordings import Recording
from jaxnav.recordings.records import MESSAGES, OUTCOME, input_message, outcome_message
from jaxnav.vehicles import replay
from jaxnav.vehicles.options import number, whole_number
from tests.fuzz.judge import small_programs
from tests.fuzz.kept import kept_cases, replayed
from tests.fuzz.seeds import write_drive
from tests.helpers.drives import make_input, make_outcome
from tests.helpers.loader_seeds import BINARY, STRUCTURED, Loader
from tests.helpers.mutations import edited_by, places_in, restructured_by
from tests.helpers.seed_texts import PARAMETERS
from tests.helpers.simulated import make_setup
from tests.helpers.yaml_numbers import dumped

LOADERS = STRUCTURED | BINARY
EXAMPLES = int(os.environ.get("JAXNAV_FUZZ", "8"))
HANGS_S = 2.0  # of the processor, so that a machine that is busy does not count
LONGEST = 1200  # characters of a line for a person


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Iterator[Path]:
    """Where a loader's file lies; beside it is where temporary files would."""
    temporary, folder = tmp_path / "temporary", tmp_path / "files"
    temporary.mkdir()
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    yield folder
    assert list(temporary.iterdir()) == []


def told(loader: Loader, path: Path, folder: Path) -> str | None:
    """The line that a person gets, or None: what was read is sound."""
    before = sorted(folder.rglob("*"))
    began_s = time.process_time()
    try:
        loaded = loader.load(path)
    except BadInput as bad:
        line = str(bad)
        assert str(folder) in line or line.startswith("--"), line
        assert "\n" not in line
        assert len(line) < LONGEST, line[:LONGEST]
    else:
        line = None
        assert_sound(loaded)
    assert time.process_time() - began_s < HANGS_S
    assert sorted(folder.rglob("*")) == before
    return line


def assert_sound(loaded: Any) -> None:
    """Numbers of what came out of a file are finite; poses are poses."""
    if isinstance(loaded, Recording):
        lanes = (len(loaded.stamps_ns), len(loaded.rig), len(loaded.markers.ids))
        assert loaded.corners_px.shape == (*lanes, 4, 2)
        assert loaded.visible.shape == lanes
        assert np.all(np.diff(loaded.stamps_ns) > 0)
        assert np.isfinite(loaded.corners_px).all()
        loaded = (loaded.rig, loaded.markers)
    for leaf in jax.tree.leaves(loaded):
        if isinstance(leaf, jax.Array | float):
            assert np.isfinite(np.asarray(leaf)).all()
        if isinstance(leaf, jax.Array) and leaf.ndim and leaf.shape[-1] == 7:
            assert np.allclose(np.linalg.norm(leaf[..., :4], axis=-1), 1, atol=1e-3)


@pytest.mark.parametrize("name", LOADERS)
def test_bytes_of_a_file_that_change_are_noticed_or_do_not_matter(name, folder):
    loader = LOADERS[name]
    path = loader.make(folder)
    whole = path.read_bytes()
    assert told(loader, path, folder) is None
    for example in range(EXAMPLES):
        path.write_bytes(edited_by(Random(f"{name} {example}"), whole))
        told(loader, path, folder)


@pytest.mark.parametrize("name", LOADERS)
def test_only_regular_files_are_read(name, folder, monkeypatch):
    """A pipe whose other end nobody opens, a device that never ends: neither is waited for."""
    loader = LOADERS[name]
    path = loader.make(folder)
    path.unlink()
    monkeypatch.chdir(path.parent)  # the path of a socket must be short

    def hangs(number: int, frame: Any) -> None:
        raise TimeoutError("it is waited for")

    signal.signal(signal.SIGALRM, hangs)
    with socket.socket(socket.AF_UNIX) as end:
        for put in (
            lambda: os.mkfifo(path),
            lambda: path.symlink_to("/dev/zero"),
            lambda: end.bind(path.name),
        ):
            put()
            signal.alarm(20)
            line = told(loader, path, folder)
            signal.alarm(0)
            assert line == f"{path}: is a device, a pipe or a socket: only regular files are read"
            path.unlink()
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    path.mkdir()  # which a recording may be: then it lacks what it must hold
    # A box of a store whose file is missing is one that is not done.
    assert told(loader, path, folder) is not None or "/c/" in name


@pytest.mark.parametrize("name", STRUCTURED)
def test_a_value_that_changes_is_noticed_by_its_key_or_does_not_matter(name, folder):
    loader = STRUCTURED[name]
    path = loader.make(folder)
    dump = json.dumps if path.suffix == ".json" else dumped
    data = read_mapping(path)
    for example in range(EXAMPLES):
        changed = restructured_by(Random(f"{name} {example}"), data, list(places_in(data)))
        path.write_text(dump(changed.data))
        line = told(loader, path, folder)
        assert line is None or changed.is_named_in(line), line


def used_drive(path: Path) -> None:
    """All that the commands make of a drive before they drive or draw it."""
    replay._read.cache_clear()  # two files may be written in one tick of the disk's clock
    log = read_drive(path)
    setup = DriveSetup.from_header(log.header, path)
    assert_sound((setup.rig, setup.markers, setup.vehicle))
    if len(log.outcomes.now_ns):
        assert all(isinstance(line, str) for line in summary_lines(log))
    told = Setup(setup.rig, setup.markers, setup.vehicle, (0, 0, 0), options={"drive": str(path)})
    replay.open_cameras(told, replay.ReplayVehicle(told))


def test_a_value_of_a_drive_that_changes_is_noticed_by_its_key_or_does_not_matter(folder):
    messages = [input_message(make_input(index))[::2] for index in range(3)]
    messages.append((OUTCOME, outcome_message(make_outcome(0))))
    header = dataclasses.replace(make_setup(), parameters=PARAMETERS).header()
    whole = {name: json.loads(encode(part)) for name, part in [("header", header), *messages]}
    path, loader = folder / "drive.mcap", Loader(lambda folder: folder, used_drive)
    write_drive(path, list(whole.items()))
    assert told(loader, path, folder) is None
    for example in range(5 * EXAMPLES):
        changed = restructured_by(Random(example), whole, list(places_in(whole)))
        known = [(topic, part) for topic, part in changed.data.items() if topic in MESSAGES]
        write_drive(path, [("header", changed.data.get("header")), *known])
        line = told(loader, path, folder)
        # Of a camera that is gone the frames are told that have none.
        assert line is None or changed.is_named_in(line) or "/frames.camera" in line, line


@settings(max_examples=EXAMPLES, derandomize=True)
@given(st.text(max_size=9) | st.floats().map(str) | st.integers().map(str))
def test_an_option_is_a_number_within_its_bounds_or_bad_input(text):
    for read, kind in ((number, float), (whole_number, int)):
        try:
            value = read({"key": text}, "key", 1, 0, 10)
        except BadInput as bad:
            assert str(bad).startswith("--option key: expected a ")  # noqa: PT017
        else:
            assert type(value) is kind
            assert 0 <= value <= 10


# --- the failures once found by the long run (`make fuzz`) stay fixed ---


@pytest.fixture(scope="module")
def beside(tmp_path_factory):
    """Where sound files are made once."""
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("place", kept_cases(), ids=lambda place: place.name)
def test_what_failed_once_is_told_in_a_line_or_does_not_matter(place, beside, monkeypatch):
    # Commands choose a precision and a cache for their process; tests keep theirs.
    monkeypatch.setattr("jax.config.update", lambda name, value: None)
    scratch = beside / place.name
    scratch.mkdir()
    with small_programs():
        assert replayed(place, scratch) is None
