"""Every document, heading and file that is referred to exists."""

import io
import re
import subprocess
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
READ = {".py", ".md", ".toml", ".ipynb", ".yaml", ".txt"}
# Documents of earlier days, which the repository lacks; in capitals, so that prose may go on.
LACKING = re.compile(r"(?<![\w`])(?:RELI" + r"ABILITY|DES" + r"IGN|LAY" + r"OUT|STY" + r"LE|FOR"
                     + r"MATS)(?![\w`])")  # fmt: skip
# "docs/design.md, Gate", also where the line ends after the comma.
POINTER = re.compile(r"docs/(design|promises)\.md,\s+(?:#\s*)?([A-Z][\w' \n#]*)")


def _sources() -> dict[str, str]:
    """The text of every file under version control, or beside it and not ignored."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("no checkout: which files belong to the repository is not known")
    paths = (ROOT / name for name in listed.stdout.splitlines())
    kept = [
        path
        for path in paths
        if path.is_file() and (path.suffix in READ or path.name == "Makefile")
    ]
    return {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
        for path in kept
        if path != Path(__file__).resolve()
    }


def _prose(name: str, text: str) -> str:
    """Comments and strings of Python, where a name in capitals is no constant; else all of it."""
    if not name.endswith(".py"):
        return text
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return "\n".join(t.string for t in tokens if t.type in (tokenize.COMMENT, tokenize.STRING))


def _headings(name: str) -> set[str]:
    """Headings of a document, and what stands in bold at the beginning of a promise."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    promises = re.findall(r"^\| \*\*([^*]+?)\.?\*\*", text, re.MULTILINE)
    return set(re.findall(r"^#+ (.+)$", text, re.MULTILINE)) | set(promises)


def test_no_file_names_a_document_that_is_not_there():
    found = [
        f"{name}: {match.group()}"
        for name, text in _sources().items()
        for match in LACKING.finditer(_prose(name, text))
    ]
    assert found == []


@pytest.mark.parametrize(
    ("text", "is_named"),
    [
        ("# see DES" + "IGN 3.5", True),
        ('"""The limits (RELI' + 'ABILITY R10)."""', True),
        ("# See LAY" + "OUT.md.", True),
        ("FOR" + "MATS = {}", False),
        ('"""A key of `FOR' + 'MATS`."""', False),
        ("RELI" + "ABILITY_BINS = 20  # reliability", False),
    ],
)
def test_a_name_in_prose_is_told_from_a_constant(text, is_named):
    assert bool(LACKING.search(_prose("a.py", text + "\n"))) == is_named


def test_every_heading_that_is_named_exists():
    headings = {name: _headings(name) for name in ("design", "promises")}
    pointers = [
        (file, document, " ".join(rest.replace("#", " ").split()))
        for file, text in _sources().items()
        for document, rest in POINTER.findall(text)
    ]
    assert len(pointers) >= 5
    for file, document, named in pointers:
        assert any(named.startswith(heading) for heading in headings[document]), (file, named)


def test_the_design_names_files_and_tests_that_exist():
    text = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:\w+/)*\w+\.py)(?:::(\w+))?`", text)
    assert len(named) >= 20
    for name, test in named:
        path = next((p for p in (ROOT / name, ROOT / "jaxnav" / name) if p.is_file()), None)
        assert path is not None, name
        assert f"def {test.partition('[')[0]}" in path.read_text(encoding="utf-8") or not test, name
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert (ROOT / "docs" / link).is_file(), link


def test_what_the_fast_run_names_is_there():
    for line in (ROOT / "tests" / "fast.txt").read_text(encoding="utf-8").split():
        file, _, test = line.partition("::")
        assert f"def {test.partition('[')[0]}" in (ROOT / file).read_text(encoding="utf-8"), line
