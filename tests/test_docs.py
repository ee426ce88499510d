"""The pages can be followed: their links lead somewhere, commands parse, and the Python runs."""

import functools
import re
import shlex
import tomllib
from pathlib import Path

import jax
import pytest
import yaml

from jaxnav import cli

ROOT = Path(__file__).resolve().parents[1]
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
PAGES = [README, CONTRIBUTING, ROOT / "calib" / "README.md"] + [
    page for folder in (ROOT / "docs", ROOT / "benchmarks") for page in sorted(folder.rglob("*.md"))
]
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"(?<!`)`([^`]+)`(?!`)")
LINK = re.compile(r"\]\(([^()\s]+)\)")
FOLDERS = r"(?:jaxnav|tests|benchmarks|docs|calib|notebooks)/"
# What a reader puts a word of his own for, with one that is allowed there.
PLACEHOLDERS = {
    "--scenario NAME": "--scenario slip",
    "--selector NAME": "--selector paper-cost",
    "study KIND": "study ambiguity",
}


def relative(page: Path) -> str:
    return str(page.relative_to(ROOT))


@functools.cache
def without_fences(page: Path) -> str:
    return FENCED.sub("", page.read_text(encoding="utf-8"))


def links(text: str) -> list[str]:
    return LINK.findall(SPAN.sub("", text))


def anchors(page: Path) -> set[str]:
    """Of the headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", without_fences(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def broken(page: Path, links: list[str]) -> list[str]:
    """Links of a page that lead to no file, or to no heading of one."""
    found = []
    for link in links:
        path, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", link):
            continue  # of the world outside, which no test asks
        target = (page.parent / path).resolve() if path else page
        if (
            not target.exists()
            or ROOT not in target.parents
            or (anchor and anchor not in anchors(target))
        ):
            found.append(link)
    return found


def command_lines(page: Path) -> list[tuple[str, bool]]:
    """Every `jaxnav COMMAND ...`, and whether it stands in a line of its own, to be typed."""
    text = page.read_text(encoding="utf-8")
    blocks = [body for kind, body in FENCED.findall(text) if kind in ("", "sh", "bash")]
    typed = "\n".join([*blocks, *re.findall(r"^ {4,}(.*)$", without_fences(page), re.MULTILINE)])
    found = []
    for line in re.sub(r"\\\n\s*", " ", typed).splitlines():
        commands = (part.strip() for part in line.partition("#")[0].split(";"))
        found += [(command, True) for command in commands if command.startswith("jaxnav ")]
    spans = (" ".join(span.split()) for span in SPAN.findall(without_fences(page)))
    return found + [(span, False) for span in spans if re.match(r"jaxnav [a-z-]", span)]


def problem_of(args: list[str]) -> str:
    """What the command line says to these arguments; nothing where they are right."""
    try:
        cli._parse(args)
    except cli.UsageError as error:
        return str(error)
    return ""


COMMANDS = sorted({(command, whole) for page in PAGES for command, whole in command_lines(page)})


def test_every_link_leads_somewhere() -> None:
    lost = {relative(page): broken(page, links(without_fences(page))) for page in PAGES}
    assert not {page: links for page, links in lost.items() if links}


def test_a_broken_link_is_seen() -> None:
    text = "[a](nowhere.md) [b](README.md#not-a-heading) ![c\nd](docs/none.png) `[e](f)` [g](#no)"
    found = ["nowhere.md", "README.md#not-a-heading", "docs/none.png", "#no"]
    assert broken(README, links(text)) == found
    assert broken(README, links("[a](#in-python) [b](docs/guide/drive.md#recordings)")) == []


def test_every_command_can_be_typed() -> None:
    problems = {}
    for command, whole in COMMANDS:
        line = command
        for placeholder, word in PLACEHOLDERS.items():
            line = line.replace(placeholder, word)
        problem = problem_of(shlex.split(line)[1:])
        # In a sentence a command may be named without all that it needs.
        named = problem.startswith(("Missing", "Expected one of")) and not whole
        if problem and not named:
            problems[command] = problem
    assert not problems


def test_commands_were_found() -> None:
    assert ("jaxnav run --car qcar --record drive.mcap", True) in COMMANDS
    assert ("jaxnav faults", False) in COMMANDS
    names = {line.split()[1] for line, _ in COMMANDS}
    assert {"demo", "replay", "locate", "simulate", "study", "tune", "calibrate"} <= names


def test_every_file_that_is_named_is_there() -> None:
    missing = []
    for page in PAGES:
        text = without_fences(page)
        named = set(re.findall(rf"(?:python|pytest) ({FOLDERS}[\w/]+\.py)", text))
        for span in SPAN.findall(text):
            if match := re.fullmatch(rf"({FOLDERS}[\w./-]*)(::\w+)?", span):
                named.add(match[1])
        missing += [(relative(page), name) for name in named if not (ROOT / name).exists()]
    assert not missing


@pytest.mark.parametrize("page", [README, CONTRIBUTING], ids=relative)
def test_every_target_of_make_is_there(page: Path) -> None:
    typed = r"(?m)(?:^ {4}|`|=\S+ )make (?:[A-Z]+=\S+ )*([a-z]+)"
    targets = re.findall(typed, without_fences(page))
    declared = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    assert {"test"} <= set(targets) <= set(declared)


def test_every_guide_is_reached_from_the_readme() -> None:
    linked = {link.partition("#")[0] for link in links(without_fences(README))}
    guides = {relative(page) for page in PAGES if page.parent.name == "guide"}
    assert guides
    assert guides <= linked


def test_the_python_of_the_readme_runs(monkeypatch, capsys) -> None:
    (source,) = (body for kind, body in FENCED.findall(README.read_text()) if kind == "python")
    monkeypatch.chdir(ROOT)
    names: dict = {}
    with jax.enable_x64(False):
        exec(compile(source, "README.md", "exec"), names)
    decided = re.findall(r"True|False", capsys.readouterr().out)
    assert decided == ["False", "False", "False", "True"]
    x_m, y_m, psi_rad = names["out"].pose
    assert f"{x_m:.2f} m, {y_m:.2f} m, {psi_rad:.2f} rad" in " ".join(README.read_text().split())


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    assert citation["title"] == project["name"]
    assert str(citation["version"]) == project["version"]
    assert citation["license"] == project["license"]


def test_hooks_are_local() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    assert [repo["repo"] for repo in hooks["repos"]] == ["local"]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for hook in hooks["repos"][0]["hooks"]:
        assert hook["language"] == "system"
        assert hook["entry"].replace(".venv/bin", "$(BIN)") in makefile
