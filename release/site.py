"""What the site of the documentation has beside the pages of docs/: files from outside, and the table of commands."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from cotap.command_help import Command, Option, load_commands

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {
    "CHANGELOG.md": "CHANGELOG.md",
    "CITATION.cff": "CITATION.cff",
    "NOTICE": "NOTICE.txt",
    "README.md": "overview.md",
    "src/cotap/checkpoints/README.md": "card.md",
}
"""Files of the repository that the site has too, and how it calls them; all of examples/ as well."""
MEASURED = ("results.md", "results_g1.md", "redundancy.md")
"""Pages that reports write once there is a policy to measure; the site has those that are there."""
COMMANDS = "<!-- commands -->"
"""Where a page has the table of commands."""
_LINK = re.compile(r"(?<=\]\()([^)#:\s]+)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Leave pages that are not written yet out of the navigation."""
    missing = {name for name in MEASURED if not Path(config.docs_dir, name).is_file()}
    for section in config.nav or []:
        for title, pages in section.items():
            if isinstance(pages, list):
                section[title] = [page for page in pages if missing.isdisjoint(page.values())]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is outside of docs/."""
    for path, name in _outside().items():
        files.append(File.generated(config, name, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Fill in titles and commands, and let links to files outside of docs/ lead to the site's copies of them."""
    source, outside, docs = Path(str(page.file.abs_src_path)).parent, _outside(), Path(config.docs_dir)

    def in_site(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(source / link[1]))
        inside = target.is_relative_to(docs)
        name = target.relative_to(docs) if inside else outside.get(os.path.relpath(target, ROOT))
        return link[1] if name is None else os.path.relpath(name, Path(page.file.src_uri).parent)

    markdown = _LINK.sub(in_site, markdown)
    if not markdown.startswith("#"):  # a table that a report wrote
        markdown = f"# {page.title}\n\n{markdown}"
    return markdown.replace(COMMANDS, commands()) if COMMANDS in markdown else markdown


def commands() -> str:
    """All commands as Markdown, with their options; fields of a training's config aside."""
    parts = []
    for name, command in load_commands().items():
        parts.append(f"## cotap {name}".rstrip() + f"\n\n{command.about}\n")
        parts.append(_table(command))
        hidden = sum(option.group == "config" for option in command.options)
        if hidden:
            parts.append(f"And {hidden} fields of the config: `cotap {name} --help-all` lists them.\n")
    return "\n".join(parts)


def _table(command: Command) -> str:
    rows = [f"| `{part}` | | {about} |" for part, about in command.parts.items()]
    rows += [_row(option) for option in command.options if option.group != "config"]
    return "\n".join(["| option | default | meaning |", "|---|---|---|", *rows, ""])


def _row(option: Option) -> str:
    label = option.label.replace("|", "\\|")
    note = option.note if option.required else f"`{option.note}`" if option.note else ""
    return f"| `{label}` | {note} | {option.help} |".replace("<", "&lt;")


def _outside() -> dict[str, str]:
    examples = (file.relative_to(ROOT).as_posix() for file in sorted((ROOT / "examples").glob("*.py")))
    return OUTSIDE | {name: name for name in examples}
