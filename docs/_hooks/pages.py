"""What mkdocs shows beside docs/: pages that live elsewhere in the repository, and their links.

Every page stays readable where it lies: its links are those of the repository, and lead to the same
thing on the site. A link to a file that is no page of the site leads to a copy of the file.
"""

import re
import runpy
from collections import defaultdict
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from urllib.parse import unquote

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
# What stands first, in this order; whatever else lies in docs/ follows.
GUIDE_FIRST = "selectors studies tuning drive calibrate formats plugins".split()
SAFETY = "promises spoofing ranges files".split()

LINK = re.compile(r"(!?)\[([^\]\[]*(?:\[[^\]]*\][^\]\[]*)*)\]\(([^()\s]+)\)")
CODE = re.compile(r"^(`{3,}|~{3,}).*?^\1[^\n]*$|(?<!`)(`+)(?!`).+?(?<!`)\2(?!`)", re.M | re.S)


@event_priority(100)  # before mkdocs-jupyter, which takes over the notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages from elsewhere and says in which order all are shown."""
    own = sorted(file.src_uri for file in files.documentation_pages())
    elsewhere = {"README.md": "index.md", "calib/README.md": "guide/your-own-car.md"}
    for path in sorted(ROOT.glob("benchmarks/README-*.md")):
        name = path.relative_to(ROOT).as_posix()
        elsewhere[name] = f"measurements/{path.stem.removeprefix('README-')}.md"
    notebooks = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("notebooks/*.ipynb"))

    for repository, site in elsewhere.items():
        file = File.generated(config, site, abs_src_path=str(ROOT / repository))
        file.edit_uri = None
        files.append(file)
    for notebook in notebooks:
        files.append(
            File(notebook, str(ROOT), config.site_dir, use_directory_urls=config.use_directory_urls)
        )
    reference = dict(reference_pages())
    for site, text in reference.items():
        files.append(File.generated(config, site, content=text))

    guide = [page for page in own if page.startswith("guide/")]
    guide.sort(key=lambda page: placed(GUIDE_FIRST, page))
    at_top = [page for page in own if "/" not in page and page != "index.md"]
    rest = [page for page in at_top if PurePosixPath(page).stem not in (*SAFETY, "api")]
    safety = [page for page in at_top if PurePosixPath(page).stem in SAFETY]
    config.nav = [
        {"Home": "index.md"},
        {"Guide": [*guide, "guide/your-own-car.md"]},
        {"What it keeps": sorted(safety, key=lambda page: placed(SAFETY, page))},
        *rest,
        {"In Python": [page for page in at_top if page == "api.md"] + list(reference)},
        {"Notebooks": notebooks},
        {"Measurements": [site for site in elsewhere.values() if site.startswith("measurements/")]},
    ]
    SITE_OF.clear()
    SITE_OF.update(elsewhere)
    SITE_OF.update(
        {f"docs/{file.src_uri}": file.src_uri for file in files if not file.generated_by}
    )
    SITE_OF.update({notebook: notebook for notebook in notebooks})
    return files


SITE_OF: dict[str, str] = {}  # a file of the repository -> the page or picture of the site


def placed(first: list[str], page: str) -> tuple[int, str]:
    """The key that sorts the named pages to the front."""
    stem = PurePosixPath(page).stem
    return (first.index(stem) if stem in first else len(first), stem)


def reference_pages() -> list[tuple[str, str]]:
    """A page for every module that has public names, with what mkdocstrings fills in."""
    names_of = defaultdict(list)
    public = runpy.run_path(str(ROOT / "jaxnav/__init__.py"))
    for name in public["__all__"]:
        names_of[public["_MODULE_OF"][name]].append(name)
    pages = []
    for module, names in sorted(names_of.items()):
        lines = [f"# jaxnav.{module}", ""]
        for name in names:
            lines += [f"::: jaxnav.{module}.{name}", "    options:"]
            lines += [f'      heading: "jaxnav.{name}"', f'      toc_label: "{name}"', ""]
        pages.append((f"reference/{module}.md", "\n".join(lines)))
    return pages


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links of the repository, as links of the site."""
    site = page.file.src_uri
    source = next((path for path, uri in SITE_OF.items() if uri == site), None)
    if source is None:
        return markdown
    codes = [code.span() for code in CODE.finditer(markdown)]
    folder = PurePosixPath(source).parent

    def rewritten(link: re.Match[str]) -> str:
        if any(begin <= link.start() and link.end() <= end for begin, end in codes):
            return link[0]  # what stands in code is no link; a link's text may hold code
        picture, label, target = link.groups()
        path, _, anchor = target.partition("#")
        if not path or "://" in path or path.startswith(("mailto:", "/")):
            return link[0]
        inside = normpath(folder / unquote(path))
        if inside in SITE_OF:
            to = SITE_OF[inside]
        elif inside.startswith("..") or not (ROOT / inside).exists():
            return link[0]  # mkdocs will complain
        elif (ROOT / inside).is_dir():
            return f"{label} (`{inside}/`)" if inside not in label else label
        else:
            to = f"source/{inside}.txt"
            if files.get_file_from_path(to) is None:
                text = (ROOT / inside).read_text(encoding="utf-8")
                files.append(File.generated(config, to, content=text))
        to = relpath(to, str(PurePosixPath(site).parent))
        return f"{picture}[{label}]({to}{'#' * bool(anchor)}{anchor})"

    return LINK.sub(rewritten, markdown)
