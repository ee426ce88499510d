"""The command line: typed arguments reach the command, and wrong ones get a one-line error."""

import dataclasses
import os
import re
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest

from jaxnav import cli
from jaxnav.commands import COMMANDS, names
from jaxnav.commands.drive.arguments import Locate, ReplayRecording
from jaxnav.commands.simulate.arguments import Demo
from jaxnav.errors import BadInput

JAXNAV = [sys.executable, "-c", "import sys; from jaxnav.cli import main; sys.exit(main())"]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable], list]:
    """Puts a function in place of every command; the list holds what the commands were given."""

    def install(run: Callable) -> list:
        received = []
        for one in COMMANDS.values():
            module = types.ModuleType(one.module)
            module.run = lambda args: received.append(args) or run()
            monkeypatch.setitem(sys.modules, f"jaxnav.commands.{one.module}", module)
        return received

    return install


def test_arguments_reach_the_command(command) -> None:
    received = command(lambda: 0)
    for typed in (
        "demo --seed 3 --no-blur --exposure-ms 2 --rig a.yaml --out x",
        "replay --limit 5 --one-at-a-time --markers m.yaml bag",
        "locate a.png --camera c.yaml --marker-size-m 0.1 --as-json",
    ):
        assert cli.main(typed.split()) == 0
    assert received == [
        Demo(seed=3, blur=False, exposure_ms=2.0, rig=Path("a.yaml"), out=Path("x")),
        ReplayRecording(Path("bag"), limit=5, one_at_a_time=True, markers=Path("m.yaml")),
        Locate(Path("a.png"), camera=Path("c.yaml"), marker_size_m=0.1, as_json=True),
    ]


def test_the_exit_code_is_the_commands(command) -> None:
    command(lambda: 7)
    assert cli.main(["demo"]) == 7


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("", "jaxnav: Expected one of {demo, replay, locate, simulate, reliability, study, plot, "),
        ("fly", "jaxnav: Unrecognized options: fly; Available subcommands: demo, replay, locate"),
        ("demo --fast", "jaxnav demo: Unrecognized options: --fast"),
        ("demo --sed 3", "jaxnav demo: Unrecognized options: --sed, 3; Perhaps you meant: --seed"),
        ("demo --seed x", "jaxnav demo: --seed: invalid literal for int()"),
        ("demo --seed", "jaxnav demo: Missing value for argument '--seed'"),
        ("demo --seed -1", "jaxnav demo: --seed: must be at least 0, got -1"),
        ("demo --seeds 0", "jaxnav demo: --seeds: must be at least 1, got 0"),
        ("demo --exposure-ms nan", "jaxnav demo: --exposure-ms: must be finite, got nan"),
        ("demo --duration-s 0", "jaxnav demo: --duration-s: must be greater than 0, got 0.0"),
        ("demo --selector best", "jaxnav demo: invalid choice 'best' for argument '--selector'"),
        ("replay", "jaxnav replay: Missing from jaxnav replay: RECORDING"),
        ("replay a b", "jaxnav replay: Unrecognized options: b"),
        ("replay a --limit ten", "jaxnav replay: --limit: invalid literal for int()"),
        ("replay a --limit 0", "jaxnav replay: --limit: must be at least 1, got 0"),
        ("locate a.png --camera c", "jaxnav locate: Missing from jaxnav locate: --marker-size-m"),
        (
            "locate a.png --camera c --marker-size-m -0.1",
            "jaxnav locate: --marker-size-m: must be from 0.001 to 100 m, got -0.1",
        ),
        ("tune filter --seeds 0", "jaxnav tune: --seeds: must be at least 1, got 0"),
        ("calibrate rig", "jaxnav calibrate: RECORDING: missing: what has the rig seen?"),
    ],
)
def test_wrong_usage_gets_one_line(arguments, line, command, capsys) -> None:
    received = command(lambda: 0)
    assert cli.main(arguments.split()) == cli.EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert err.startswith(line)
    assert err.count("\n") == 1
    assert out == ""
    assert received == []


def test_a_long_path_stays_whole(capsys) -> None:
    path = "/" + "/".join(["a_rather_long_folder"] * 12)
    assert cli.main(["demo", path]) == cli.EXIT_BAD_INPUT
    assert path in capsys.readouterr().err


def test_the_line_is_the_same_under_every_encoding() -> None:
    # tyro frames its messages with box characters or with blanks, as the encoding allows.
    lines = set()
    for encoding in ("utf-8", "ascii"):
        environment = os.environ | {"PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
        run = subprocess.run(
            [*JAXNAV, "demo", "--sed", "3"], env=environment, capture_output=True, text=True
        )
        assert run.returncode == cli.EXIT_BAD_INPUT
        lines.add(run.stderr)
    (line,) = lines
    assert "Unrecognized options: --sed, 3; Perhaps you meant: --seed INT, --seeds INT" in line


@pytest.mark.parametrize(
    ("raised", "code", "line"),
    [
        (
            BadInput("rig.yaml: cameras[1].lens", "unknown lens 'fish'\nexpected one of ..."),
            cli.EXIT_BAD_INPUT,
            "jaxnav demo: rig.yaml: cameras[1].lens: unknown lens 'fish' expected one of ...\n",
        ),
        (KeyboardInterrupt(), cli.EXIT_INTERRUPTED, "jaxnav demo: interrupted\n"),
        (ZeroDivisionError(), None, ""),  # a defect keeps its traceback
    ],
)
def test_what_a_command_raises_gets_one_line(command, capsys, raised, code, line) -> None:
    def run() -> int:
        raise raised

    command(run)
    if code is None:
        with pytest.raises(type(raised)):
            cli.main(["demo"])
    else:
        assert cli.main(["demo"]) == code
    assert capsys.readouterr() == ("", line)


POSITIONALS = tuple(
    "recording image store config kind recordings source sources target one other file".split()
)
POSITIONAL = {
    "recordings": "RECORDING",
    "sources": "SOURCE",
    "file": "FILE",
    "one": "FILE",
    "other": "FILE",
    "kind": r"\{ambiguity,drive\}",
    "target": r"\{charuco,aprilgrid,chessboard,marker\}",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_explains_every_flag(name, capsys) -> None:
    command = COMMANDS[name].arguments
    assert cli.main([*name.split(), "--help"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "{None}" not in out
    for field in dataclasses.fields(command):
        flag = "--" + field.name.replace("_", "-")
        if field.name in POSITIONALS:
            flag = POSITIONAL.get(field.name, field.name.upper())
        assert re.search(rf"(?m)^.? ?{flag}(?!\w)", out), flag
    # A flag without a docstring would be followed by its default alone.
    unframed = " ".join(out.replace("│", " ").split())
    assert not re.search(r"--[\w-]+( \S+)? \((default|optional|required)", unframed)


def test_a_flag_takes_the_same_kind_of_value_in_all_commands() -> None:
    """A switch, a path, a word, a whole number or another: units are in the names."""
    kinds: dict[str, dict[str, str]] = {}
    for command, one in COMMANDS.items():
        for field in dataclasses.fields(one.arguments):
            kinds.setdefault(field.name, {})[_kind(field.type)] = command
    assert {name: said for name, said in kinds.items() if len(said) > 1} == {}


def _kind(hint: Any) -> str:
    """bool, int, float, str or Path, of values of which there may be none or several."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if get_origin(hint) is Literal:
        return "str"
    inner = [one for one in get_args(hint) if one not in (type(None), Ellipsis)]
    return hint.__name__ if not inner else _kind(inner[0])


def test_help_and_version_name_themselves(capsys) -> None:
    assert cli.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in names())
    assert cli.main(["--version"]) == 0
    assert re.fullmatch(r"jaxnav \d+\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.skipif(sys.platform == "win32", reason="no os.wait4 on Windows")
def test_help_takes_little_more_than_what_reads_the_command_line() -> None:
    """0.3 s where importing tyro takes 0.13, see bench_loop; processor time, the best of five."""

    def least_s(argv: list[str]) -> float:
        seconds = []
        for _ in range(5):
            process = subprocess.Popen(argv, stdout=subprocess.DEVNULL)
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            assert process.returncode == 0
            seconds.append(usage.ru_utime + usage.ru_stime)
        return min(seconds)

    assert least_s([*JAXNAV, "--help"]) <= 4 * least_s([sys.executable, "-c", "import tyro"])


@pytest.mark.parametrize(
    "command", ["replay", "plot", "calibrate rig", "study ambiguity", "tune filter", "demo --out"]
)
def test_a_name_that_is_too_long_is_one_line(command, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jaxnav.commands.process.configure", lambda **_: None)
    assert cli.main([*command.split(), "x" * 300]) == cli.EXIT_BAD_INPUT
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.endswith("file name too long")
    assert f"jaxnav {command.split()[0]}: xxx" in last


@pytest.mark.parametrize(
    ("module", "args", "name", "value"),
    [
        ("tune.controller", ["tune", "controller"], "TF_CPP_MIN_LOG_LEVEL", "3"),
        ("drive.run", ["run"], "OPENBLAS_NUM_THREADS", "1"),
    ],
)
def test_libraries_find_what_they_ask_for_when_they_are_imported(module, args, name, value) -> None:
    """XLA prints no advice to file a bug, NumPy starts no threads beside a drive's; who sets either
    is obeyed."""
    script = (
        "import os, sys; from types import SimpleNamespace; from jaxnav import cli\n"
        "def found(event, args):\n"
        "    if event == 'import' and args[0] == 'numpy' and not values:\n"
        "        values.append(os.environ[sys.argv[2]])\n"
        "values = []; sys.addaudithook(found)\n"
        "module = SimpleNamespace(run=lambda *args: 0)\n"
        "sys.modules['jaxnav.commands.' + sys.argv[1]] = module\n"
        "code = cli.main(sys.argv[3:]); import numpy; print(*values, code)"
    )
    inherited = {k: v for k, v in os.environ.items() if k != name}
    for own, set_to in (({}, value), ({name: "2"}, "2")):
        run = subprocess.run(
            [sys.executable, "-c", script, module, name, *args],
            env=inherited | own,
            capture_output=True,
            text=True,
        )
        assert (run.stdout.split(), run.stderr) == ([set_to, "0"], "")


def test_a_closed_pipe_is_no_traceback() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        run = subprocess.run([*JAXNAV, "--help"], stdout=writer, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writer)
    assert (run.returncode, run.stderr) == (cli.EXIT_BROKEN_PIPE, "")


def _printed(script: str, **environment: str) -> tuple[str, str]:
    """What a script prints in a process of its own, and what it says on stderr."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XDG_"))}
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        env=inherited | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout.strip(), run.stderr


@pytest.mark.parametrize(
    ("environment", "said", "kept"),
    [
        ({"XDG_CACHE_HOME": "home"}, "", r"{0}/home/jaxnav/jaxlib-\d+\.\d+\.\d+.*-\w+-"),
        ({"XDG_CACHE_HOME": "file"}, "compiled code is not kept: {0}/file/jaxnav", "None"),
        ({"JAX_COMPILATION_CACHE_DIR": "own", "XDG_CACHE_HOME": "home"}, "", "{0}/own"),
        # Not a byte of it is read: its entries are machine code.
        ({"JAX_COMPILATION_CACHE_DIR": "open"}, "{0}/open can be written to by all: chmod", "None"),
        ({"XDG_CACHE_HOME": "open"}, "{0}/open can be written to by all: chmod", "None"),
    ],
)
def test_where_compiled_code_is_kept(tmp_path, environment, said, kept) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    script = (
        "import jax, jax.numpy as jnp; from jaxnav.commands.process import configure_jax\n"
        "configure_jax(float64=True)\n"
        "jax.jit(lambda x: jnp.linalg.inv(x))(jnp.eye(3)).block_until_ready()\n"
        "print(jax.config.jax_compilation_cache_dir, jnp.zeros(1).dtype)"
    )
    given = {name: str(tmp_path / value) for name, value in environment.items()}
    out, err = _printed(script, **given, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0")
    folder, dtype = out.split()
    assert re.match(kept.format(tmp_path), folder)
    assert dtype == "float64"
    assert said.format(tmp_path) in err
    assert len(err.splitlines()) == bool(said)
    assert not any((tmp_path / "open").iterdir())
    assert (tmp_path / "home" / "jaxnav").exists() == (kept.startswith("{0}/home"))
    if kept.startswith("{0}/home"):
        assert Path(folder).stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(
    ("threads", "asked", "platforms"),
    [(1, "", "cpu"), (1, "cpu,cuda", "cpu,cuda"), (None, "", "")],
)
def test_a_single_car_is_computed_on_the_processor(tmp_path, threads, asked, platforms) -> None:
    """Unless the user says where; studies take what JAX takes."""
    script = (
        "import jax; from jaxnav.commands.process import configure_jax\n"
        f"configure_jax(float64=False, threads={threads}); print(jax.config.jax_platforms)"
    )
    found, _ = _printed(script, JAX_PLATFORMS=asked, XDG_CACHE_HOME=str(tmp_path))
    assert found == platforms
