"""The command line: `jaxnav COMMAND`.

What a command does lies in `jaxnav.commands` and is imported when the command runs, so that
`--help` stays instant; they are registered in `jaxnav/commands/__init__.py`.

Exit codes: 0 done, 1 what was to be found out is not well (a replay is not what was recorded, the
doctor found an error, a fault came to worse than it must, the watchdog stopped the car), 2 bad
input or usage (one line on stderr), 130 interrupted; `run`: 128 plus the number of the signal that
ended it, or 1 where the vehicle's guard did not say that it was heard.
"""

import contextlib
import dataclasses
import importlib
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TextIO, cast

from jaxnav.drive.output import FreeOutput, fill_descriptors
from jaxnav.drive.signals import Interrupted, Signals
from jaxnav.errors import EXIT_BAD_INPUT as EXIT_BAD_INPUT
from jaxnav.errors import EXIT_INTERRUPTED as EXIT_INTERRUPTED
from jaxnav.errors import BadInput, visible

EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE
FILES = 64  # that a drive may have open: some 30 of its own, and those of drivers

DESCRIPTION = (
    "Localise and drive a vehicle with one square marker and several cameras. "
    "`jaxnav COMMAND --help` explains a command, `jaxnav --version` prints the version."
)


# Module -> its package, and the extra of ours that brings it.
_OF_EXTRAS = {name: (name, "study") for name in ("dask", "distributed", "xarray", "zarr")} | {
    "rerun": ("rerun-sdk", "viz"),
    "optax": ("optax", "tune"),
}


class UsageError(Exception):
    """The command line itself is wrong; the message is one line."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code of the process.

    Args:
        argv: the arguments after the program's name, by default those of the process.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    # Libraries ask for these once, when they are imported, which the arguments' ranges do.
    if args[:1] not in (["run"], ["ros"]):
        # XLA advises to file a bug where it compiles for two minutes. Its failures are exceptions.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
        return _main(args, _dispatch)
    # NumPy's own threads: those that look for markers have matrices so small that sharing one out
    # takes longer than it does, and the cores are theirs.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A car may move: from here on no signal is lost, and no terminal holds anything up.
    fill_descriptors()
    import resource  # of POSIX, as a drive is; other commands need none

    if 0 <= (allowed := resource.getrlimit(resource.RLIMIT_NOFILE)[0]) < FILES:
        # Where there is room for fewer, not even an import may succeed, and its error is no line.
        print(f"{_name(args)}: ulimit -n: must be {FILES} or more, got {allowed}", file=sys.stderr)
        return EXIT_BAD_INPUT
    signals = Signals()
    try:
        with FreeOutput():
            code = _main(args, lambda args: _dispatch(args, signals))
        code = code if signals.exit_code is None else signals.exit_code
    finally:
        signals.ignore() if argv is None else signals.close()
    if argv is None:
        # All is closed and written. Threads of drivers and of OpenCV may still be in C code, whose
        # end while Python takes itself down is a crash with an exit code of its own.
        os._exit(code)
    return code


def _main(args: list[str], dispatch: Callable[[list[str]], int]) -> int:
    try:
        code = dispatch(args)
        # A closed pipe shows itself on flushing: here it can still be handled.
        sys.stdout.flush()
    except (BadInput, UsageError) as error:
        print(f"{_name(args)}: {visible(error)}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except Interrupted as interrupted:
        print(f"{_name(args)}: interrupted ({interrupted})", file=sys.stderr)
        return EXIT_INTERRUPTED
    except KeyboardInterrupt:
        print(f"{_name(args)}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The interpreter flushes again when it exits; give it something to flush into.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except OSError as error:
        if error.filename is None:
            raise
        problem = (error.strerror or type(error).__name__).lower()  # a name that is too long, say
        print(f"{_name(args)}: {visible(f'{error.filename}: {problem}')}", file=sys.stderr)
        return EXIT_BAD_INPUT
    return code


def _name(args: list[str]) -> str:
    """What a message begins with."""
    from jaxnav.commands import names

    return f"jaxnav {args[0]}" if args and args[0] in names() else "jaxnav"


def _dispatch(args: list[str], *signals: Signals) -> int:
    if args == ["--version"]:
        from jaxnav import __version__

        print(f"jaxnav {__version__}")
        return 0
    from jaxnav.commands import check_outputs, command_of

    command = _parse(args)
    if command is None:
        return 0
    check_outputs(command)
    try:
        module = importlib.import_module(f"jaxnav.commands.{command_of(command).module}")
        with nothing_hidden():
            code: int = module.run(command, *signals)
    except ModuleNotFoundError as missing:
        if missing.name not in _OF_EXTRAS:
            raise
        package, extra = _OF_EXTRAS[missing.name]
        raise UsageError(f"needs {package}: pip install 'jaxnav[{extra}]'") from None
    return code


class _Shown:
    """A stream that writes out what a terminal would obey, line feeds apart, and what it can't
    show. All else is the stream's own."""

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, text: str) -> int:
        shown = "\n".join(visible(line) for line in text.split("\n"))
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        self._stream.write(shown.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def nothing_hidden() -> contextlib.redirect_stdout[TextIO]:
    """While the block runs, whatever is printed to the standard output is made visible."""
    return contextlib.redirect_stdout(cast(TextIO, _Shown(sys.stdout)))


def _parse(args: list[str]) -> Any:
    """The command, or None where help was asked for and printed."""
    import tyro

    from jaxnav.commands import all_arguments
    from jaxnav.commands.kinds import check_values

    args, words = _without_ros_args(args)
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages), _lines_unwrapped(args):
            command: Any = tyro.cli(
                all_arguments(), prog="jaxnav", description=DESCRIPTION, args=args
            )
    except SystemExit as finished:
        if not finished.code:
            return None
        raise UsageError(_one_line(messages.getvalue())) from None
    command = getattr(command, "what", command)  # of a group
    check_values(command)
    return dataclasses.replace(command, ros_args=words) if words else command


def _without_ros_args(args: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """The arguments of `jaxnav ros`, and those from --ros-args on, which are ROS's own."""
    if args[:1] != ["ros"] or "--ros-args" not in args:
        return args, ()
    at = args.index("--ros-args")
    return args[:at], tuple(args[at:])


@contextlib.contextmanager
def _lines_unwrapped(args: list[str]) -> Iterator[None]:
    """Let tyro print long lines whole except of help, so that no path in a message is broken."""
    before = os.environ.get("COLUMNS")
    if not {"-h", "--help"} & set(args):
        os.environ["COLUMNS"] = "100000"
    try:
        yield
    finally:
        os.environ.pop("COLUMNS", None)
        os.environ |= {} if before is None else {"COLUMNS": before}


def _one_line(box: str) -> str:
    """What tyro's box of an error says, without its frame and the help it repeats.

    Options stand indented by 4, their help texts deeper.
    """
    sections: list[list[str]] = [[]]
    for framed in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()[1:-1]:
        line = framed[2:-2].rstrip()
        if set(line) <= {"─", "-"}:
            sections.append([])
        elif not line.startswith(" " * 5):
            sections[-1].append(line)
    problems = (
        lines for lines in sections if lines and not lines[0].startswith(("For full", "Argument"))
    )
    text = " ".join("; ".join(_listed(lines) for lines in problems).split())
    # A command has its class's name; one of `tune` and `calibrate` stands in the field `what`.
    return re.sub(r"^Error parsing ([A-Z]\w*: |what: )?", "", text) or "wrong usage"


def _listed(lines: list[str]) -> str:
    head = " ".join(line for line in lines if not line.startswith(" "))
    indented = (line.strip() for line in lines if line.startswith(" "))
    items = ", ".join(item for item in indented if item != "[...]")
    return f"{head} {items}".strip()
