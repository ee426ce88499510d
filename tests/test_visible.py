"""Foreign names and texts are harmless when shown: no terminal codes, no formulas in pictures."""

import sys

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxnav.calibrate.board.images import source_files
from jaxnav.cli import main, nothing_hidden
from jaxnav.commands.report import save_figure
from jaxnav.errors import BadInput, Containment, visible
from jaxnav.files.images import decode_image
from jaxnav.vehicles.opencv_cameras import _device
from tests.helpers.seed_texts import OPENCV

NASTY = ["\x1b[31mred", "a\nb", "a\rb", "\u202eevil", "\u200b", "\x9b1m", "\udcff", "\x00"]


@pytest.mark.parametrize("text", NASTY)
def test_what_a_terminal_obeys_is_written_out(text):
    shown = visible(text)
    assert shown.isprintable()
    assert shown.encode("ascii").decode("unicode_escape").encode("utf-8", "surrogatepass")
    for line in (str(BadInput(text, "is bad")), str(BadInput("a.yaml", f"got {text}"))):
        assert line.isprintable()


def test_what_anybody_can_read_stays():
    for text in ("", "drive.mcap", "Straße 4, 中文", r"C:\new", "a b"):
        assert visible(text) == text
    assert str(BadInput("a.yaml: key", "must be\n  one line")) == "a.yaml: key: must be one line"


def test_a_line_feed_in_a_name_does_not_make_two_lines_of_it(tmp_path, capsys):
    path = tmp_path / "a\nb\x1b[2J.mcap"
    assert main(["plot", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert r"a\nb\x1b[2J.mcap" in err


def test_a_wrong_flag_is_told_without_its_escapes(capsys):
    assert main(["plot", "--\x1b[31mout", "x"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "\x1b" not in err


def test_what_a_command_prints_is_made_visible(capsys):
    with nothing_hidden():
        print("one\x1b[31m\ntwo\u202e", end="")
        sys.stdout.flush()
    assert capsys.readouterr().out == "one\\x1b[31m\ntwo\\u202e"
    print("\x1b", end="")  # and nothing is changed afterwards
    assert capsys.readouterr().out == "\x1b"


def test_what_the_output_can_not_encode_is_written_out(tmp_path, monkeypatch):
    with (tmp_path / "out").open("w", encoding="ascii") as stream:
        monkeypatch.setattr("sys.stdout", stream)
        with nothing_hidden():
            print("Straße")
    assert (tmp_path / "out").read_text() == "Stra\\xdfe\n"


@pytest.mark.parametrize("name", ["$\\frac$", "$", "\x1b[31m", "中文", "a\n\tb"])
def test_a_picture_shows_any_name(name, tmp_path):
    figure = Figure(layout="constrained")
    axes = figure.add_subplot()
    axes.plot([1, 2], [1e-3, 1e3], label=name)
    axes.set_yscale("log")
    axes.set_title(name)
    axes.set_xlabel(name)
    axes.text(1, 1, name)
    axes.legend(title=name)
    figure.suptitle(name)
    save_figure(figure, tmp_path / "a.png")
    assert decode_image((tmp_path / "a.png").read_bytes()) is not None
    assert axes.get_title().replace("\n", "").isprintable()


def test_digits_of_other_scripts_are_no_numbers(tmp_path):
    names = ["10.png", "2.png", "²1.png", "٣.png", "9" * 100 + ".png"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    found = [path.name for path in source_files([tmp_path])]
    assert found.index("2.png") < found.index("10.png")
    assert sorted(found) == sorted(names)
    assert _device("²") is None
    assert _device("9" * 5000) is None
    assert _device("2") == 2


def test_a_library_adds_no_line_to_ours(tmp_path, capfd):
    whole = cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (60, 60), np.uint8))[1]
    path = tmp_path / "a.png"
    for cut in (bytes(whole)[:200], bytes(whole)[:100] + bytes(50) + bytes(whole)[150:]):
        path.write_bytes(cut)
        camera = tmp_path / "camera.yml"
        camera.write_text(OPENCV)
        given = [str(path), "--camera", str(camera), "--marker-size-m", "0.2"]
        main(["locate", *given])
        assert capfd.readouterr().err.count("\n") <= 1
        assert main(["calibrate", "intrinsics", str(path), "--board", str(path)]) == 2
        assert capfd.readouterr().err.count("\n") == 1


def test_what_raises_is_named_counted_said_once_a_minute_and_ends_nothing(monkeypatch):
    now_s, said = [100.0], []
    monkeypatch.setattr("jaxnav.errors.time.monotonic", lambda: now_s[0])
    contained = Containment(said.append)

    def divide(a, b):
        return a / b

    for _ in range(3):
        assert contained.wrap("/odom", divide, lambda problem, a, b: (problem, a))(1, 0) == (
            "/odom: ZeroDivisionError: division by zero",
            1,
        )
    assert contained.wrap("/odom", divide)(1, 2) == 0.5
    now_s[0] += 61.0
    assert contained.wrap("/odom", divide)(1, 0) is None
    problem = "/odom: ZeroDivisionError: division by zero"
    assert said == [problem, f"{problem} (4 times so far)"]
    assert contained.summary() == "raised, and were left out: /odom 4"


def test_nor_does_what_is_done_about_it(capsys):
    """What is done instead may raise, and so may whoever is told; nothing that is said is long."""

    def fails(*arguments):
        raise ValueError("x" * 100_000 + "\x1b[31m")

    assert Containment().wrap("a", fails, fails)() is None
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert len(line) < 1100
    assert "\x1b" not in line
    contained = Containment(fails)
    assert contained.wrap("a", fails, fails)() is None
    assert contained.counts == {"a": 2}
