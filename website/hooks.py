"""Hooks of MkDocs, set as ``hooks`` in mkdocs.yml, which add the pages made from the code or kept outside docs/."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

REPO = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPO))

from website import links, pages, tutorials  # noqa: E402  (MkDocs loads this file without its package)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add all pages that are not files in docs/."""
    shown = {page: REPO / name for name, page in links.OUTSIDE.items() if page != "index.md"}
    for folder in ("examples", "examples/trainers", "results", "results/figures"):
        for path in (REPO / folder).iterdir():
            if path.is_file() and path.suffix != ".jsonl":
                shown[path.relative_to(REPO).as_posix()] = path
    for name, path in sorted(shown.items()):
        files.append(File.generated(config, name, abs_src_path=str(path)))
    made = {name: text.encode() for name, text in pages.made().items()} | tutorials.made()
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Point links at pages of the site."""
    return links.on_site(markdown, page.file.src_uri)
