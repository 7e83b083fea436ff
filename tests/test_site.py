"""The site of the documentation: it builds without a warning, every link in it leads somewhere, nothing is fetched."""

from __future__ import annotations

import copy
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag

import pytest
from mkdocs.config.defaults import MkDocsConfig

from cotap.command_help import load_commands
from release import site as release_site

ROOT = Path(__file__).parents[1]
LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}
"""Elements that a browser loads by itself, with the attribute that says from where."""


class Page(HTMLParser):
    """What a page links to, loads, and can be linked at."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors = {""}
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value is not None}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag in LOADED and LOADED[tag] in given and given.get("rel") != "canonical":
            self.loaded.append(given[LOADED[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {file: Page(file) for file in site.rglob("*.html") if file.name != "404.html"}


def pages_of(nav: list[Any]) -> set[str]:
    """All pages of a navigation."""
    return {page for section in nav for pages in section.values() for part in pages for page in part.values()}


def test_pages_that_are_not_measured_yet_are_left_out(tmp_path: Path):
    """And only these: any other page that is missing is an error of the site."""
    config = MkDocsConfig()
    config.docs_dir = str(tmp_path)
    nav = [{"Results": [{"Ships": "shipped.md"}, {"On G1": "results_g1.md"}, {"Arms": "redundancy.md"}]}]
    for there, expected in (
        ([], {"shipped.md"}),
        (["redundancy.md"], {"shipped.md", "redundancy.md"}),
        (["results_g1.md"], {"shipped.md", "results_g1.md", "redundancy.md"}),
    ):
        for name in there:
            (tmp_path / name).touch()
        config.nav = copy.deepcopy(nav)
        assert pages_of(release_site.on_config(config).nav or []) == expected


def test_what_reports_may_write_is_in_the_navigation():
    written = (ROOT / "mkdocs.yml").read_text()
    assert [name for name in release_site.MEASURED if f": {name}\n" not in written] == []


@pytest.mark.slow
def test_every_link_leads_to_a_page_and_a_place_on_it(pages: dict[Path, Page]):
    broken, seen = [], 0
    for file, page in pages.items():
        for link in (*page.links, *page.loaded):
            path, anchor = (unquote(part) for part in urldefrag(link))
            if "://" in path or path.startswith("mailto:"):
                continue
            target, seen = (file.parent / path).resolve() if path else file, seen + 1
            if not target.is_file() or (target in pages and anchor not in pages[target].anchors):
                broken.append(f"{file.name}: {link}")
    assert not broken
    assert seen > 1000


@pytest.mark.slow
def test_a_browser_loads_nothing_from_elsewhere(site: Path, pages: dict[Path, Page]):
    assert not [link for page in pages.values() for link in page.loaded if "//" in link]
    assert not [css for css in site.rglob("*.css") if "url(http" in css.read_text() or "@import" in css.read_text()]


@pytest.mark.slow
def test_the_reference_has_what_is_public(pages: dict[Path, Page], site: Path):
    from cotap import compliance

    anchors = pages[site / "reference/compliance.html"].anchors
    assert {name for name in compliance.__all__ if f"cotap.compliance.{name}" not in anchors} == set()
    headings = pages[site / "reference/commands.html"].anchors
    assert {f"cotap-{name}".replace(" ", "-") for name in load_commands() if name} <= headings
