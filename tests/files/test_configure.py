"""`jn.configure()`: what it sets and what it leaves alone; no flag can abort the process."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxnav.files import configuration

ROOT = Path(__file__).resolve().parents[2]
OURS = [f"--{flag}={value}" for flag, value in configuration.FLAGS.items()]
# What this jaxlib takes of them; the suite has XLA's answer already.
KNOWN = configuration.known_flags(configuration.FLAGS)
TAKEN = [f"--{flag}={value}" for flag, value in KNOWN.items()]
SHOWN = (
    "import json, os, jax; print(json.dumps([os.environ.get('XLA_FLAGS'),"
    " os.environ.get('PJRT_NPROC'), jax.config.jax_enable_x64,"
    " jax.config.jax_compilation_cache_dir]))"
)


def shown(script: str, tmp_path: Path, **environment: str) -> tuple[list, str]:
    """[XLA_FLAGS, PJRT_NPROC, float64, cache folder] after a script, and what stderr has."""
    unset = ("JAX_", "XLA_", "XDG_", "PJRT_", "PYTHONWARNINGS")
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(unset)}
    run = subprocess.run(
        [sys.executable, "-c", f"{script}\n{SHOWN}"],
        env=inherited | {"XDG_CACHE_HOME": str(tmp_path)} | environment,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout), run.stderr


def test_one_call_sets_what_the_commands_set(tmp_path) -> None:
    """And a process that then computes lives; what jaxlib said is asked once."""
    script = (
        "import jaxnav as jn; jn.configure(float64=True, threads=1)\n"
        "import jax.numpy as jnp; jnp.zeros(1).block_until_ready()\n"
        "jn.configure(float64=True, threads=1)"
    )
    (flags, threads, float64, folder), said = shown(script, tmp_path)
    assert (flags.split(), threads, float64) == (TAKEN, "1", True)
    assert Path(folder).parent == tmp_path / "jaxnav"
    assert said == ""
    asked = list((Path(folder) / "steps").glob("flags-*.json"))
    assert sorted(KNOWN) in [json.loads(kept.read_text()) for kept in asked]
    assert len(asked) == 1 + (KNOWN != configuration.FLAGS)  # the second call asks for the others
    for kept in asked:
        kept.write_text("[]")
    (flags, *_), said = shown("import jaxnav as jn; jn.configure()", tmp_path)
    assert (flags, said) == (None, "")  # as it was told before


def test_a_flag_or_value_that_xla_does_not_know_is_left_out(tmp_path) -> None:
    """Whose process lives; one that has it does not."""
    script = (
        "import jaxnav as jn; from jaxnav.files import configuration\n"
        "configuration.FLAGS['xla_cpu_no_such_flag'] = 'true'\n"
        "configuration.FLAGS['xla_cpu_experimental_ynn_fusion_type'] = 'NO_SUCH_TYPE'\n"
        "jn.configure(cache=False)\n"
        "import jax.numpy as jnp; assert jnp.zeros(1).sum() == 0"
    )
    (flags, *_), said = shown(script, tmp_path)
    ynn = "xla_cpu_experimental_ynn_fusion_type"
    taken = " ".join(f"--{flag}={value}" for flag, value in KNOWN.items() if flag != ynn)
    assert (flags or "", said) == (taken, "")
    assert list(tmp_path.iterdir()) == []


def test_what_comes_too_late_is_said_in_one_line_and_changes_nothing(tmp_path) -> None:
    script = (
        "import jaxnav as jn; import jax.numpy as jnp; jnp.zeros(1)\n"
        "jn.configure(float64=True, threads=1)"
    )
    (flags, threads, float64, folder), said = shown(script, tmp_path)
    assert (flags, threads, float64) == (None, None, True)
    assert Path(folder).parent == tmp_path / "jaxnav"
    (first, *rest) = said.splitlines()
    assert "RuntimeWarning: PJRT_NPROC and XLA_FLAGS come too late" in first
    assert len(rest) <= 1  # Python shows the line that called


@pytest.fixture
def asked(monkeypatch) -> list[dict[str, str]]:
    """What a child would have been asked; it takes all."""
    questions: list[dict[str, str]] = []
    monkeypatch.setattr(configuration, "_survives", lambda flags: not questions.append(flags))
    monkeypatch.setattr(configuration, "step_folder", lambda: None)
    return questions


@pytest.mark.parametrize(
    ("theirs", "becomes"),
    [
        ("", " ".join(OURS)),
        ("--xla_own=1", " ".join(["--xla_own=1", *OURS])),
        ("--xla_cpu_use_fusion_emitters=true", f"--xla_cpu_use_fusion_emitters=true {OURS[1]}"),
        (" ".join(reversed(OURS)), " ".join(reversed(OURS))),
        ("/etc/flags_of_xla", "/etc/flags_of_xla"),  # a file's name
    ],
)
def test_the_users_flags_stay(asked, theirs: str, becomes: str) -> None:
    assert configuration._with_flags(theirs) == becomes
    assert len(asked) == (theirs != becomes)


def test_where_no_child_can_be_started_no_flag_is_set(monkeypatch, asked) -> None:
    def fails(flags: dict[str, str]) -> bool:
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(configuration, "_survives", fails)
    assert configuration._with_flags("--xla_own=1") == "--xla_own=1"


def test_the_path_of_a_cache_is_judged_as_the_commands_is(tmp_path) -> None:
    own, others = tmp_path / "own", tmp_path / "others"
    others.mkdir()
    others.chmod(0o777)
    given = f"--xla_own=1 {' '.join(OURS)}"
    for folder, kept in ((own, str(own)), (others, None)):
        script = (
            "import jaxnav as jn; from pathlib import Path\n"
            f"jn.configure(cache=Path({str(folder)!r}))"
        )
        (flags, _, float64, found), said = shown(script, tmp_path, XLA_FLAGS=given)
        assert (flags, float64, found) == (given, False, kept)
        assert ("can be written to by all" in said) == (kept is None)
