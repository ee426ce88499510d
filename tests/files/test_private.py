"""Folders whose content is executed: files that others could have put there are never read."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxnav.files import private
from jaxnav.files.private import (
    NotPrivateError,
    private_folder,
    read_private,
    require_own_entries,
    write_private,
)

SOMEBODY = 12345
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")


@pytest.fixture
def folder(tmp_path) -> Path:
    """With a file in it."""
    path = tmp_path / "outer" / "inner"
    write_private(private_folder(path, make=True) / "one", b"content")
    return path


def read(path: Path) -> bytes:
    require_own_entries(found := private_folder(path))
    return read_private(found / "one")


def test_what_is_written_is_read_and_is_this_users_alone(folder):
    assert read(folder) == b"content"
    for path in (folder.parent, folder):
        assert path.stat().st_mode & 0o777 == 0o700
    assert (folder / "one").stat().st_mode & 0o777 == 0o600
    write_private(private_folder(folder) / "one", b"newer")
    assert read(folder) == b"newer"
    assert [path.name for path in folder.iterdir()] == ["one"]


@pytest.mark.parametrize("part", ["outer", "outer/inner", "outer/inner/one"])
@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_a_part_that_others_can_write_to(folder, tmp_path, part, mode):
    folder.chmod(0o755)  # or nobody could get at the file, whatever its mode
    (tmp_path / part).chmod(mode)
    with pytest.raises(NotPrivateError, match=f"{part} can be written to by (all|its group)"):
        read(folder)
    (tmp_path / part).chmod(0o755)
    assert read(folder) == b"content"


def test_all_may_write_to_a_part_where_names_are_their_owners_alone(folder):
    folder.parent.chmod(0o1777)  # as /tmp is
    assert read(folder) == b"content"
    folder.chmod(0o1777)
    with pytest.raises(NotPrivateError, match="inner can be written to by all"):
        read(folder)


@needs_root
@pytest.mark.parametrize("part", ["outer", "outer/inner", "outer/inner/one"])
def test_a_part_that_is_somebody_elses(folder, tmp_path, part):
    os.chown(tmp_path / part, SOMEBODY, -1)
    with pytest.raises(NotPrivateError, match=f"{part} belongs to another user, number {SOMEBODY}"):
        read(folder)


@needs_root
def test_a_user_does_not_trust_another_ones_folder_and_trusts_roots(folder, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: SOMEBODY)
    assert read(folder) == b"content"  # root's
    os.chown(folder, SOMEBODY, -1)
    assert read(folder) == b"content"  # one's own
    monkeypatch.setattr(os, "geteuid", lambda: SOMEBODY + 1)
    with pytest.raises(NotPrivateError, match="belongs to another user"):
        read(folder)


@pytest.mark.parametrize("part", ["outer", "outer/inner", "outer/inner/one"])
def test_a_link_is_not_followed(folder, tmp_path, part):
    path = tmp_path / part
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(NotPrivateError, match=f"{part} is a link"):
        read(folder)


def test_a_link_in_the_root_folder_is_followed(monkeypatch, folder):
    linked = Path("/", folder.parts[1])
    monkeypatch.setattr(Path, "is_symlink", lambda path: path == Path("/short"))
    monkeypatch.setattr(Path, "readlink", lambda path: linked.relative_to("/"))
    assert private_folder(Path("/short", *folder.parts[2:])) == folder


def test_no_file_and_no_folder(folder, tmp_path):
    (folder / "pipe").unlink(missing_ok=True)
    os.mkfifo(folder / "pipe", 0o600)
    (folder / "deep").mkdir(mode=0o700)
    for name in ("pipe", "deep", "missing"):
        with pytest.raises(OSError):  # noqa: PT011
            read_private(private_folder(folder) / name)
    for path in (folder / "one", folder / "one" / "more", tmp_path / "missing"):
        with pytest.raises(OSError):  # noqa: PT011
            private_folder(path)


def test_a_large_file_is_not_read(folder, monkeypatch):
    monkeypatch.setattr(private, "_MAX_BYTES", 3)
    with pytest.raises(OSError, match="no file of at most 3 bytes"):
        read(folder)


def test_what_a_killed_process_has_left_is_removed_and_a_living_one_keeps_its_own(folder):
    left, living = (folder / f".jaxnav-{16 * digit}.step" for digit in "ab")
    for path in (left, living):
        path.write_bytes(b"half")
    os.utime(left, (0, 0))
    write_private(private_folder(folder) / "two", b"2")
    assert {path.name for path in folder.iterdir()} == {"one", "two", living.name}
    assert read(folder) == b"content"


# Two processes that write the same file, as often as a byte is to be seen.
WRITERS = """
import os, sys
from pathlib import Path
from jaxnav.files.private import private_folder, write_private

for letter in (b"a", b"b"):
    if os.fork() == 0:
        folder = private_folder(Path(sys.argv[1]), make=True)
        for _ in range(200):
            write_private(folder / "one", letter * 10_000)
        os._exit(0)
assert [os.wait()[1] for _ in "ab"] == [0, 0]
"""


def test_two_at_once_leave_one_whole_file(tmp_path):
    path = tmp_path / "new" / "folder"
    subprocess.run([sys.executable, "-W", "ignore", "-c", WRITERS, path], check=True, timeout=120)
    assert read(path) in (b"a" * 10_000, b"b" * 10_000)
    assert [file.name for file in path.iterdir()] == ["one"]
