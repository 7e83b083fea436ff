"""What the pages say of imports is so, and their links lead somewhere."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from cotap.evaluation import report

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [*DOCS.rglob("*.md"), DOCS.parent / "README.md", DOCS.parent / "CHANGELOG.md"]


def anchors(page: Path) -> set[str]:
    """What can be linked at in a page: its headings, as GitHub and mkdocs name them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    names = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", name).strip().lower()) for name in names}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS.parent).as_posix())
def test_links_of_a_page_lead_somewhere(page):
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        generated = target.parent.name == "reference"  # the site has these anchors: tests/test_site.py
        if "://" not in path and (not target.exists() or (anchor and not generated and anchor not in anchors(target))):
            broken.append(link)
    assert not broken


def test_links_of_pages_are_found_at_all():
    assert anchors(DOCS / "evaluation.md") >= {"evaluation", "measures"}
    assert len(re.findall(r"\]\(([^)\s]+)\)", "".join(page.read_text() for page in PAGES))) > 50


def test_the_glossary_has_every_measure():
    text = (DOCS / "glossary.md").read_text()
    known = {*report.UNITS, *report.LESS_IS_BETTER, *report.MORE_IS_BETTER, "slope_x", "slope_y", "slope_yaw"}
    assert {name for name in known if f"`{name}`" not in text} == set()


def test_modules_import_what_the_table_of_the_architecture_lets_them():
    rows = re.findall(r"^\| ([\w, ]+) \| ([^|]+) \|$", (DOCS / "architecture.md").read_text(), re.M)
    table = {name.strip(): set(re.findall(r"\w+", may)) for names, may in rows for name in names.split(",")}
    package = DOCS.parent / "src/cotap"
    seen: set[tuple[str, str]] = set()
    for file in package.rglob("*.py"):
        own = file.relative_to(package).parts[0].removesuffix(".py")
        for line in ast.walk(ast.parse(file.read_text())):
            if isinstance(line, ast.ImportFrom) and (line.module or "").startswith("cotap."):
                seen.add((own, (line.module or "").split(".")[1]))
    packages = {p.name for p in package.iterdir() if (p / "__init__.py").is_file()}
    assert packages - {"play", "motions", "sim"} <= table.keys()  # the table is read at all
    free = {name for name, may in table.items() if "everything" in may} | {
        "train",
        "evaluate",
        "export",
        "deploy",
        "compare",
    }
    wrong = {(a, b) for a, b in seen if a != b and a not in free and b not in table.get(a, set())}
    assert not wrong, f"imports that docs/architecture.md does not name: {sorted(wrong)}"
