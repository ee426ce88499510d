"""Whether a command, or a loader, did with a file what it must.

A command ends with 0, 1 or 2; with 2 it has said one line; it never shows a traceback or what a
terminal obeys, leaves its input as it was, and writes where it was told to and nowhere else.
"""

import contextlib
import hashlib
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jax._src import compiler

from jaxnav import cli
from jaxnav.errors import BadInput, visible

LONGEST = 1300  # characters of a line for a person
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2066-\u2069]")
_PACKAGE = str(Path(cli.__file__).parent)


class Skipped(BaseException):
    """All that reads and checks is done; what would follow takes too long for many runs."""


def of_command(argv: list[str], inputs: Path, elsewhere: Path) -> str | None:
    """Run a command in this process; what is wrong with what it did, None: nothing.

    Args:
        inputs: a folder that must stay as it is.
        elsewhere: an empty folder, to be the current one, that must stay empty.
    """
    before = _digests(inputs)
    with contextlib.chdir(elsewhere), _captured() as told:
        try:
            code: int | str = cli.main(argv)
        except Skipped:
            code = "skipped"
        except SystemExit as ended:
            code = f"SystemExit {ended.code}"
        except BaseException:
            return told_of(sys.exc_info()[1])
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
    out, err = (stream.decode("utf-8", "backslashreplace") for stream in told())
    if code not in (0, 1, 2, "skipped"):
        return f"code {code}: {visible(err[:300])}"
    # The doctor says what it finds, files that are not understood among it, where it says all.
    if (
        code == 2
        and not (argv[0] == "doctor" and out and not err)
        and (err.count("\n") != 1 or len(err) > LONGEST or not err.strip())
    ):
        return f"code 2 with {err.count(chr(10))} lines: {visible(err[:300])}"
    for name, text in (("stdout", out), ("stderr", err)):
        if "Traceback" in text and f"{Skipped.__name__}\n" not in text:
            return f"traceback on {name}: {visible(text[-300:])}"
        if found := _OBEYED.search(text):
            return f"{name} has {found[0]!r}: {visible(text[:200])}"
    if _digests(inputs) != before:
        return "the input was changed"
    if left := sorted(path.name for path in elsewhere.rglob("*")):
        return f"written elsewhere: {left}"
    return None


def of_loader(load: Callable[[Path], object], path: Path) -> str | None:
    """Read a file; what is wrong with what came of it, None: nothing."""
    try:
        load(path)
    except BadInput as bad:
        line = str(bad)
        if len(line) > LONGEST or _OBEYED.search(line) or "\n" in line:
            return f"a bad line: {visible(line[:200])}"
    except Skipped:
        return None
    except BaseException as error:
        return told_of(error)
    return None


def told_of(error: BaseException | None) -> str:
    """Kind, place in the package and message of an error: the same for the same defect."""
    assert error is not None
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if frame.filename.startswith(_PACKAGE)] or list(frames)
    last = ours[-1]
    place = f"{Path(last.filename).name}:{last.lineno} {last.name}"
    return f"{type(error).__name__} at {place}: {visible(str(error)[:200])}"


@contextlib.contextmanager
def _captured() -> Iterator[Callable[[], tuple[bytes, bytes]]]:
    """What is written to descriptors 1 and 2, by libraries too."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        streams = sys.stdout, sys.stderr  # a test runner's, perhaps
        sys.stdout, sys.stderr = (
            os.fdopen(os.dup(number), "w", encoding="utf-8", errors="backslashreplace")
            for number in (1, 2)
        )
        read: list[bytes] = []
        try:
            yield lambda: (read[0], read[1])
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.close()
            sys.stdout, sys.stderr = streams
            for number, descriptor in enumerate(kept, 1):
                os.dup2(descriptor, number)
                os.close(descriptor)
            for file in (out, err):
                file.seek(0)
                read.append(file.read(2**20))


def _digests(folder: Path) -> dict[str, str]:
    return {
        str(path): hashlib.blake2b(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


@contextlib.contextmanager
def small_programs(most_bytes: int = 150_000) -> Iterator[None]:
    """Meanwhile what would compile for seconds raises `Skipped`: so many runs share the programs
    that were compiled before.

    Args:
        most_bytes: of a program's text; by default some 0.5 s to compile.
    """
    compile_now = compiler.backend_compile_and_load

    def guarded(backend: Any, module: Any, *args: Any, **kwargs: Any) -> Any:
        if len(str(module)) > most_bytes:
            raise Skipped
        return compile_now(backend, module, *args, **kwargs)

    compiler.backend_compile_and_load = guarded
    try:
        yield
    finally:
        compiler.backend_compile_and_load = compile_now
