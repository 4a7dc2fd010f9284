"""Links between files of the repository, turned into links between pages of the site."""

import posixpath
import re

OUTSIDE = {
    "CHANGELOG.md": "changelog.md",
    "CODE_OF_CONDUCT.md": "code-of-conduct.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
    "SECURITY.md": "security.md",
    "packages/papers/PERCEPTION.md": "perception.md",
}
"""File outside docs/ -> its page. Files of results/ and examples/ keep their paths."""

_FILES = {page: file for file, page in OUTSIDE.items() if page != "index.md"}


def page_of(file: str) -> str | None:
    """Page of a file of the repository, or None if the site has none."""
    page = OUTSIDE.get(file) or (file if file.startswith(("results/", "examples/")) else None)
    if page is None and file.startswith("docs/"):
        page = file.removeprefix("docs/")
    return re.sub(r"^(tutorials/[\w-]+)\.py$", r"\1.md", page) if page else None


def file_of(page: str) -> str:
    """File that a page shows; the pages made from the code link as if they lay in docs/."""
    return _FILES.get(page) or (page if page.startswith("results/") else f"docs/{page}")


def on_site(markdown: str, page: str) -> str:
    """Rewrite the links of a page's text from files to pages; others stay."""
    folder = posixpath.dirname(file_of(page))

    def link(found: re.Match[str]) -> str:
        target = page_of(posixpath.normpath(posixpath.join(folder, found[1])))
        return f"]({posixpath.relpath(target, posixpath.dirname(page) or '.')}" if target else found[0]

    return re.sub(r"\]\((?!\w+:|#)([^)#\s]+)", link, markdown)
