"""Flags under their old names: they are understood for one release, with a line that says so."""

import dataclasses
import re
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest

from jaxnav import cli
from jaxnav.commands import COMMANDS
from jaxnav.commands.calibrate.arguments import CalibrateBoard
from jaxnav.commands.drive.arguments import ReplayRecording, Run
from jaxnav.commands.old_flags import OLD, with_new_names


def flags_of(words: str, command: str) -> list[str]:
    """The flags that are known under an old name there, as the table spells them."""
    given = [word.partition("=")[0].replace("_", "-") for word in words.split()]
    return [flag for flag in given if flag in {old.flag for old in OLD[command]}]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("run --vehicle qcar", "run --car qcar"),
        ("run --vehicle=qcar --headless", "run --car qcar --headless"),
        ("run --vehicle my_car:open", "run --car my_car:open"),
        ("run --vehicle=my_pack.car:open --option a=b", "run --car my_pack.car:open --option a=b"),
        ("run --vehicle-file v.yaml", "run --vehicle v.yaml"),
        ("doctor --vehicle sim --vehicle-file v.yaml", "doctor --car sim --vehicle v.yaml"),
        ("faults --vehicle_file v.yaml", "faults --vehicle v.yaml"),
        ("replay bag --markers one-at-a-time", "replay bag --one-at-a-time"),
        ("replay bag --markers all --limit 3", "replay bag --limit 3"),
        ("replay --record a.mcap", "replay --record-anew a.mcap"),
        ("locate --json a.png", "locate --as-json a.png"),
        ("replay bag --markers-file m.yaml", "replay bag --markers m.yaml"),
        ("calibrate rig a.mcap --markers-file m.yaml", "calibrate rig a.mcap --markers m.yaml"),
        ("calibrate board charuco --size-mm 28 --marker-mm=21.5",
         "calibrate board charuco --size-m 0.028 --marker-size-m 0.0215"),
    ],
)  # fmt: skip
def test_an_old_name_is_the_new_one_and_said(old: str, new: str, capsys) -> None:
    name = next(name for name in OLD if old.startswith(name))
    assert with_new_names(old.split()) == new.split()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(flags_of(old, name))
    said = f"jaxnav {name}: (write --.+ in place of|leave out) --.+, which goes with the next rel"
    assert all(re.match(said, line) for line in lines)
    # As it is called now it is left alone.
    assert with_new_names(new.split()) == new.split()
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    "typed",
    [
        "",
        "run --vehicle car.yaml --markers m.yaml --car sim",
        "run --vehicle ./sim",
        "run --vehicle=cars/sim",
        "run --vehicle",
        "run --record a.mcap",
        "replay bag --markers",
        "replay bag --markers ./all",
        "calibrate board charuco --size-mm --paper a3",
        "locate a.png --json=yes",
        "simulate --vehicle qcar --json a.json",
    ],
)
def test_what_is_meant_as_it_is_now_is_left_alone(typed: str, capsys) -> None:
    assert with_new_names(typed.split()) == typed.split()
    assert not capsys.readouterr().err


def test_a_flag_takes_the_same_kind_of_value_in_all_commands() -> None:
    """A switch, a path, a word, a whole number or another: units are in the names."""
    kinds: dict[str, dict[str, str]] = {}
    for command, one in COMMANDS.items():
        for field in dataclasses.fields(one.kind):
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


def test_commands_get_what_the_old_names_said(monkeypatch, capsys) -> None:
    got: list[object] = []
    monkeypatch.setattr(cli, "_dispatch", lambda args, *_: got.append(cli._parse(args)) or 0)
    for words in (
        "replay bag --markers one-at-a-time --markers-file m.yaml",
        "calibrate board charuco --size-mm 30 --marker-mm 22",
    ):
        assert cli.main(words.split()) == 0
    replay, board = got
    assert isinstance(replay, ReplayRecording)
    assert (replay.one_at_a_time, replay.markers) == (True, Path("m.yaml"))
    assert isinstance(board, CalibrateBoard)
    assert (board.size_m, board.marker_size_m) == (0.03, 0.022)
    run = cli._parse("run --vehicle replay --vehicle-file v.yaml".split())
    assert isinstance(run, Run)
    assert (run.car, run.vehicle) == ("replay", Path("v.yaml"))
    assert len(capsys.readouterr().err.splitlines()) == 6


def test_no_old_name_is_a_new_flag_of_its_command() -> None:
    """But where the value tells them apart."""
    for command, olds in OLD.items():
        fields = COMMANDS[command].kind.__dataclass_fields__
        for old in olds:
            field = old.flag.removeprefix("--").replace("-", "_")
            assert field not in fields or old.flag in ("--vehicle", "--markers")
