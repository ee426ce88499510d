"""`jaxnav doctor` from the command line: its report, its exit code, and the faults it survives."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxnav import cli
from jaxnav.commands.doctor import doctor
from jaxnav.commands.doctor.findings import LEVELS, TEXTS, Finding, Report
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir

CHECKS = "jaxnav.commands.doctor"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The clock and the disk are looked at elsewhere."""
    monkeypatch.setattr(f"{CHECKS}.computer.clock", lambda: [Finding("clock", "ok", "ticks")])
    monkeypatch.setattr(f"{CHECKS}.computer.disk", lambda folder: [Finding("disk", "ok", "turns")])


def lines_with(out: str, *words: str) -> list[str]:
    return [line for line in out.splitlines() if all(word in line for word in words)]


def test_the_qcars_own_files_are_in_order(capsys, tmp_path):
    assert cli.main(["doctor", "--json", str(tmp_path / "found.json")]) == 0
    out = capsys.readouterr().out
    assert not lines_with(out, "ERROR")
    assert not lines_with(out, "could not be looked at")
    assert lines_with(out, "ok ", "sight", "the start: marker 0 is 16 px")
    told = json.loads((tmp_path / "found.json").read_text())
    assert told["exit_code"] == 0
    names = {finding["name"] for finding in told["findings"]}
    assert names == {
        "packages", "OpenCV", "JAX", "clock", "CPU", "disk", "rig", "markers", "vehicle", "route",
        "sight", "compile cache",
    }  # fmt: skip
    # Aligned: what was found begins in the same column everywhere.
    (clock,), (route,) = lines_with(out, "clock", "ticks"), lines_with(out, "route", "waypoints,")
    assert clock.index("ticks") == route.index("2 waypoints")
    assert out.splitlines()[-1].endswith(" ok")


def test_an_unreadable_file_is_exit_code_2_and_hides_nothing(capsys, tmp_path):
    (tmp_path / "rig.yaml").write_text("cameras: [")
    (tmp_path / "vehicle.yaml").write_text("wheelbase_m: 0\n")
    bad = ["--rig", str(tmp_path / "rig.yaml"), "--vehicle", str(tmp_path / "vehicle.yaml")]
    bad += ["--route", str(tmp_path / "gone.yaml"), "--frame", "front=x.png", "--car", "sim"]
    assert cli.main(["doctor", *bad]) == cli.EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert err == ""
    assert lines_with(out, "ERROR", "rig.yaml: is not valid YAML")
    assert lines_with(out, "ERROR", "vehicle.yaml: wheelbase_m: must be > 0")
    assert lines_with(out, "ERROR", "gone.yaml: can't be read")
    assert lines_with(out, "ok ", "1 of tag36h11, upright or flat")
    assert lines_with(out, "note", "picture", "not looked at")
    assert lines_with(out, "note", "plug-ins", "not opened")


def test_an_error_that_was_found_is_exit_code_1(capsys, tmp_path):
    text = (calib_dir() / "qcar" / "rig.yaml").read_text().replace("0.0953]", "-0.0953]")
    (tmp_path / "rig.yaml").write_text(text)
    assert cli.main(["doctor", "--rig", str(tmp_path / "rig.yaml")]) == 1
    assert lines_with(capsys.readouterr().out, "ERROR", "front is -0.0953 m above the ground")


def test_a_check_that_breaks_hides_no_other(capsys, monkeypatch):
    def breaks(*args):
        yield Finding("OpenCV", "ok", "half of it is there")
        raise AttributeError("module 'cv2' has no attribute 'x'")

    monkeypatch.setattr(f"{CHECKS}.computer.opencv", breaks)
    monkeypatch.setitem(sys.modules, f"{CHECKS}.car_files", None)  # can't be imported
    assert cli.main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert lines_with(out, "ok ", "half of it is there")
    assert lines_with(out, "ERROR", "OpenCV", "could not be looked at: AttributeError: module")
    assert lines_with(out, "ERROR", "markers", "could not be looked at: ModuleNotFoundError")
    assert lines_with(out, "ok ", "compile cache")


def test_pictures_are_named_by_their_cameras(capsys, tmp_path):
    image = tmp_path / "a=b.png"
    cv2.imwrite(str(image), np.full((410, 820), 90, np.uint8))
    assert cli.main(["doctor", "--frame", f"front={image}"]) == 0
    assert lines_with(capsys.readouterr().out, "WARNING", "picture", "no marker of the map (0 of")
    assert cli.main(["doctor", "--frame", f"top={image}"]) == 2
    assert lines_with(capsys.readouterr().out, "the rig has no camera 'top': expected one of front")
    assert cli.main(["doctor", "--frame", f"front={tmp_path / 'gone.png'}"]) == 2
    assert lines_with(capsys.readouterr().out, "gone.png: can't be read")


def test_plug_ins_get_their_options(capsys, monkeypatch):
    told = []
    monkeypatch.setattr(
        f"{CHECKS}.plug_ins.examine", lambda report, setup, *names: told.append((setup, names))
    )
    arguments = "--car car:open --cameras eyes:open --option a=1 --option b=x=y"
    assert cli.main(["doctor", *arguments.split()]) == 0
    ((setup, names),) = told
    assert names == ("car:open", "eyes:open")
    assert setup.options == {"a": "1", "b": "x=y"}
    assert setup.start_pose[:2] == (2.0, -1.0)


def wrong():
    raise BadInput("--flag", "is wrong")


def test_the_report():
    report = Report()
    assert (report.exit_code, report.summary()) == (0, "")
    report.examine("a", lambda: [Finding("a", "note", "x"), Finding("a", "warning", "y")])
    assert report.exit_code == 0
    report.add(Finding("c", "error", "broken"))
    assert report.exit_code == 1
    report.examine("d", wrong)
    assert report.exit_code == 2
    assert [finding.what for finding in report.findings] == ["x", "y", "broken", "--flag: is wrong"]
    assert report.summary() == "2 errors, 1 warning, 1 note"
    told = "ERROR    a              x y\n" + " " * 9 + "do: z"
    assert str(Finding("a", "error", "x\ny", "z")) == told


def test_every_finding_has_its_words_and_something_to_do():
    sources = "".join(path.read_text() for path in Path(doctor.__file__).parent.glob("*.py"))
    for name, entries in TEXTS.items():
        for short, entry in entries.items():
            (level,) = entry.keys() - {"do"}
            assert level in LEVELS, f"{name}.{short}"
            assert "do" in entry or level == "ok", f"{name}.{short}"
            found_there = f'"{name}.{short}"' in sources or f'{{name}}.{short}"' in sources
            assert found_there, f"{name}.{short}"


def test_the_checks_are_imported_only_when_they_run():
    """What is ill must not keep the doctor from coming."""
    source = Path(doctor.__file__).read_text()
    top = [line for line in source.splitlines() if line.startswith(("import", "from"))]
    assert not any(name in line for line in top for name in ("jax.", "cv2", "numpy", "runtime"))
