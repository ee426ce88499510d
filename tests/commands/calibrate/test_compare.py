"""`jaxnav calibrate compare`: two files of a camera, a map of where they differ."""

import json

import cv2
import yaml

from jaxnav.cli import main
from jaxnav.files import calib_dir

RIG = calib_dir() / "qcar" / "rig.yaml"


def changed(tmp_path, change):
    rig = yaml.safe_load(RIG.read_text())
    change(rig["cameras"])
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(rig))
    return tmp_path / "other.yaml"


def test_a_camera_that_changed_is_found(tmp_path, capsys):
    def longer(cameras):
        cameras[1]["focal_px"] = [1.01 * f for f in cameras[1]["focal_px"]]
        del cameras[3]

    other = changed(tmp_path, longer)
    assert main(["calibrate", "compare", str(RIG), str(other), "--out", str(tmp_path / "c")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    report = json.loads((tmp_path / "c" / "report.json").read_text())["cameras"]
    names = list(report)
    assert report[names[0]]["rms_px"] < 1e-6
    assert 1 < report[names[1]]["rms_px"] < 5
    assert report[names[1]]["undrawn_percent"] == 0
    assert lines[1].startswith(f"{names[1]}: ")
    assert cv2.imread(str(tmp_path / "c" / "report.png")) is not None


def test_what_can_t_be_compared_gets_one_line(tmp_path, refusal):
    def renamed(cameras):
        for camera in cameras:
            camera["name"] += "2"

    def smaller(cameras):
        cameras[0]["image_size_px"] = [640, 480]

    for change, line in ((renamed, "has none of the cameras of"), (smaller, "640 x 480 pixels")):
        other = changed(tmp_path, change)
        assert line in refusal("calibrate", "compare", RIG, other, "--out", tmp_path / "c")
        assert not (tmp_path / "c").exists()
