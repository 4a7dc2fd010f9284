"""Hooks of MkDocs, set as ``hooks`` in mkdocs.yml, which add the pages made from the code."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

REPO = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPO))

from website import pages, tutorials  # noqa: E402  (MkDocs loads this file without its package)

FROM_ROOT = {
    "CHANGELOG.md": "changelog.md",
    "CODE_OF_CONDUCT.md": "code-of-conduct.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
    "SECURITY.md": "security.md",
}
"""File outside docs/ -> its name on the site."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add all pages that are not files in docs/."""
    for name, page in FROM_ROOT.items():
        if page != "index.md":
            text = (REPO / name).read_text(encoding="utf-8")
            files.append(File.generated(config, page, content=_of_root(text)))
    made = {name: text.encode() for name, text in pages.made().items()} | tutorials.made()
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    for example in sorted((REPO / "examples").rglob("*")):
        if example.is_file() and example.suffix != ".pyc":
            name = example.relative_to(REPO).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(example)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Point links to files outside docs/ at their copies on the site, and tutorials' files at their pages."""
    for up in ("", "../"):  # from docs/ and from a folder in docs/
        for name, page in FROM_ROOT.items():
            markdown = markdown.replace(f"]({up}../{name}", f"]({up}{page}")
        markdown = markdown.replace(f"]({up}../examples/", f"]({up}examples/")
    return re.sub(r"\]\((tutorials/)?([\w-]+)\.py\)", r"](\1\2.md)", markdown)


def _of_root(text: str) -> str:
    """Rewrite the links of a file in the root as if it were in docs/."""
    return re.sub(r"\]\((?!https?:|#)(docs/)?", lambda link: "](" if link[1] else "](../", text)
