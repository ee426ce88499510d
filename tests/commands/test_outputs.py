"""A command overwrites none of its inputs, under whatever name; and two processes that write one
result don't lose each other's."""

import json
import os
import signal
import typing
from pathlib import Path

import pytest

from jaxnav.cli import main
from jaxnav.commands import COMMANDS, OUTPUTS
from jaxnav.errors import BadInput
from jaxnav.files import atomic_path, atomic_write
from jaxnav.files.writing import atomic_write_all, refuse_overwriting, require_writable, sole_writer
from tests.helpers.processes import python

# What is typed, the file that would be destroyed, and the flag that is to be named.
OVERWRITING = [
    ("run --car replay --option drive=a.mcap --record a.mcap", "a.mcap", "--record"),
    ("run --rig a.yaml --record a.yaml", "a.yaml", "--record"),
    ("replay out/replay.mcap --out out --record-anew", "out/replay.mcap", "--out"),
    ("replay bag --out bag", "bag/trajectory.tum", "--out"),
    ("locate p.png --camera c.yaml --marker-size-m 0.1 --out c.yaml", "c.yaml", "--out"),
    ("view a.mcap --out a.mcap", "a.mcap", "--out"),
    ("simulate --params a.yaml --json a.yaml --resume", "a.yaml", "--json"),
    ("faults --markers a.yaml --json a.yaml", "a.yaml", "--json"),
    ("doctor --frame front=p.png --json p.png", "p.png", "--json"),
    ("demo --rig out/seed_1/report.png --out out", "out/seed_1/report.png", "--out"),
    ("reliability out/summary.json --out out", "out/summary.json", "--out"),
    ("study ambiguity a.yaml --out a.yaml", "a.yaml", "--out"),
    ("plot out/summary.json --out out", "out/summary.json", "--out"),
    ("tune filter a.mcap --test out/report.png --out out", "out/report.png", "--out"),
    ("tune controller --params out/params.yaml --out out", "out/params.yaml", "--out"),
    ("calibrate intrinsics f=shots --board b.yaml --out shots", "shots/report.png", "--out"),
    ("calibrate intrinsics shots --board b.yaml --out shots", "shots/report.png", "--out"),
    ("calibrate rig a.mcap --rig out/rig.yaml --out out", "out/rig.yaml", "--out"),
    ("calibrate markers a.mcap --markers out/markers.yaml --out out", "out/markers.yaml",
     "--out"),
    ("calibrate check a.mcap --markers out/markers.yaml --out out", "out/markers.yaml",
     "--out"),
    ("calibrate odometry a.mcap --vehicle out/vehicle.yaml --out out", "out/vehicle.yaml",
     "--out"),
]  # fmt: skip


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    """And no command gets as far as to JAX's settings."""
    monkeypatch.chdir(tmp_path)

    def never(*_, **__):
        raise AssertionError("work was begun")

    monkeypatch.setattr("jax.config.update", never)


def refused(typed: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of a command that must not begin."""
    assert main(typed.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line


def put(path: str, content: str = "mine") -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
    return file


@pytest.mark.parametrize(("typed", "path", "flag"), OVERWRITING)
def test_what_a_command_reads_it_does_not_write_over(typed, path, flag, capsys):
    file = put(path)
    line = refused(typed, capsys)
    assert f" {flag}: {path}" in line
    assert "would be written over" in line
    assert file.read_text() == "mine"


CAMERA = """cameras:
- {name: front, lens: none, focal_px: [300, 300], center_px: [320, 240], image_size_px: [640, 480],
   distortion: [], position_m: [0, 0, 0], yaw_deg: 0}
"""


@pytest.mark.parametrize("out", ["a.yaml", "./a.yaml", "link.yaml", "hard.yaml"])
def test_convert_does_not_write_over_its_source(out, capsys):
    file = put("a.yaml", CAMERA)
    Path("link.yaml").symlink_to("a.yaml")
    Path("hard.yaml").hardlink_to("a.yaml")
    line = refused(f"calibrate convert a.yaml --to kalibr --out {out}", capsys)
    assert "--out: " in line
    assert "would be written over" in line
    assert file.read_text() == CAMERA


def test_every_command_that_writes_is_in_the_table():
    for name, one in COMMANDS.items():
        if name == "calibrate convert":
            continue
        hints = typing.get_type_hints(one.arguments)
        kinds = {name: (hints[name], *typing.get_args(hints[name])) for name in OUTPUTS & {*hints}}
        writes = {name for name, kind in kinds.items() if Path in kind}
        assert bool(writes) == bool(one.in_folder or one.file or one.made), name
        assert writes <= {one.file or one.made or "out"}, name


@pytest.mark.parametrize("name", ["link", "hard", "./a", "../{here}/a", "folder/../a"])
def test_whatever_leads_to_an_input_is_the_input(name, tmp_path):
    Path("folder").mkdir()
    put("a")
    Path("link").symlink_to("a")
    Path("hard").hardlink_to("a")
    output = Path(name.format(here=tmp_path.name))
    for inputs in ([Path("a")], [None, Path("a")], [tmp_path]):
        with pytest.raises(BadInput, match=r"--out: .* is read and would be written over"):
            refuse_overwriting("--out", [None, Path("new"), output], inputs)
    refuse_overwriting("--out", [output], [Path("folder"), None, Path("missing"), Path("\0")])
    refuse_overwriting("--out", [None, Path("new")], [Path("a"), tmp_path])


def test_a_disk_to_which_letters_are_alike(monkeypatch):
    put("a.png")
    as_it_is = os.stat
    monkeypatch.setattr(os, "stat", lambda path, **how: as_it_is(str(path).lower(), **how))
    with pytest.raises(BadInput, match=r"--out: A\.PNG, which is a\.png, is read"):
        refuse_overwriting("--out", [Path("A.PNG")], [Path("a.png")])


UNWRITABLE = [
    ("/dev/full", "it is a device or a pipe"),
    ("pipe", "it is a device or a pipe"),
    ("to_full", "it is a device or a pipe"),
    ("folder", "it is a folder"),
    ("none/a", "no such file or directory"),
    ("file/a", "not a directory"),
]


@pytest.mark.parametrize(("path", "problem"), UNWRITABLE)
def test_what_can_t_be_written_shows_before_the_work(path, problem, capsys):
    os.mkfifo("pipe")
    Path("to_full").symlink_to("/dev/full")
    Path("folder").mkdir()
    put("file")
    typed = [f"simulate --json {path}", f"faults --json {path}", f"doctor --json {path}"]
    typed.append(f"locate p.png --camera c --marker-size-m 1 --out {path}")
    for one in typed:
        assert f"{path}: can't be written: {problem}" in refused(one, capsys)
    for write in (require_writable, lambda where: atomic_write(where, "x")):
        with pytest.raises(BadInput, match=problem):
            write(Path(path))
    assert Path("/dev/full").is_char_device()
    assert not list(Path().glob(".*"))


# --- how a file is written -----------------------------------------------------------------


def test_a_link_stays_and_what_it_leads_to_is_written():
    target = put("folder/target")
    Path("link").symlink_to(target)
    Path("dangling").symlink_to("folder/new")
    atomic_write("link", "new")
    atomic_write("dangling", "new")
    assert Path("link").is_symlink()
    assert target.read_text() == "new"
    assert Path("folder/new").read_text() == "new"


def test_permissions_and_owner_stay():
    secret = put("secret")
    secret.chmod(0o640)
    if os.geteuid() == 0:
        os.chown(secret, 12345, 12346)
    before = secret.stat()
    with atomic_path(secret) as beside:
        assert beside.stat().st_mode & 0o077 == 0  # nobody else reads it on the way
        beside.write_text("new")
    after = secret.stat()
    assert secret.read_text() == "new"
    assert (after.st_mode, after.st_uid, after.st_gid) == (
        before.st_mode, before.st_uid, before.st_gid,
    )  # fmt: skip
    umask = os.umask(0o022)
    os.umask(umask)
    atomic_write("fresh", "")
    assert Path("fresh").stat().st_mode & 0o777 == 0o666 & ~umask


def test_it_is_on_the_disk_before_it_has_the_name(monkeypatch):
    """Or a power cut may leave an empty file in place of the older one."""
    done = []
    fsync, replace = os.fsync, os.replace
    is_folder = os.path.isdir
    monkeypatch.setattr(
        os, "fsync", lambda fd: (done.append(("sync", is_folder(f"/proc/self/fd/{fd}"))), fsync(fd))
    )
    monkeypatch.setattr(os, "replace", lambda *names: (done.append("name"), replace(*names)))
    atomic_write("a", "x")
    if Path("/proc/self/fd").exists():
        assert done == [("sync", False), "name", ("sync", True)]


def test_of_several_all_are_written_or_none(monkeypatch):
    put("a")
    with pytest.raises(BadInput, match="none/b"):
        atomic_write_all({Path("a"): "1", Path("none/b"): "2"})
    assert Path("a").read_text() == "mine"
    assert [path.name for path in Path().iterdir()] == ["a"]


# One process that imports once, and children of it: killed in the middle of a file, or holding one.
CHILDREN = """
import os, signal, sys
from pathlib import Path
from jaxnav.files.writing import sole_writer
from jaxnav.files.writing import atomic_path

for path in ("a.txt", "b.txt"):
    if os.fork() == 0:
        with sole_writer(path), atomic_path(path) as beside:
            beside.write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    os.wait()
if (child := os.fork()) == 0:
    with sole_writer("held.txt"), atomic_path("held.txt") as beside:
        beside.write_text("half")
        os.close(1)
        os.kill(os.getpid(), signal.SIGSTOP)
os.waitpid(child, os.WUNTRACED)
print(child)
"""


def test_of_a_killed_process_nothing_stays_and_nothing_is_barred():
    held = int(python("-W", "ignore", "-c", CHILDREN).communicate(timeout=120)[0])
    try:
        assert len(list(Path().glob(".jaxnav-*"))) == 3
        with pytest.raises(BadInput, match=r"held\.txt: is being written by another process"):
            sole_writer("held.txt").__enter__()
        atomic_write("held.txt", "whole")  # who asks no lock
        with sole_writer("a.txt"):
            atomic_write("a.txt", "whole")
        left = list(Path().glob(".jaxnav-*"))
        assert len(left) == 3  # one may still be written
        for path in left[:2]:
            os.utime(path, (0, 0))
        atomic_write("a.txt", "whole")
        assert list(Path().glob(".jaxnav-*")) == left[2:]
        assert not list(Path().glob(".a.txt.lock"))
    finally:
        os.kill(held, signal.SIGKILL)


def test_a_second_process_is_told_and_loses_nothing(capsys):
    result = put("runs.json", json.dumps({"runs": []}))
    with sole_writer("runs.json"):
        for typed in ("simulate --json runs.json --resume", "simulate --json ./runs.json"):
            assert "runs.json: is being written by another process" in refused(typed, capsys)
    assert json.loads(result.read_text()) == {"runs": []}
    assert [path.name for path in Path().iterdir()] == ["runs.json"]
