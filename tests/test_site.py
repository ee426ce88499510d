"""The site of `make docs` builds, and no page of it has a broken link."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="the extra `docs` is not installed: make docs")
pytest.importorskip("mkdocs_jupyter", reason="the extra `docs` is not installed: make docs")
pytest.importorskip("mkdocstrings", reason="the extra `docs` is not installed: make docs")

ROOT = Path(__file__).parents[1]


@pytest.mark.long
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    camera = (tmp_path / "reference/core.models.camera.html").read_text(encoding="utf-8")
    assert "jaxnav.Camera" in camera
    assert "fx, fy in pixels" in camera
    assert (tmp_path / "notebooks/01_paper_experiment.html").exists()
