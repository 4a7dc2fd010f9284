"""The tutorials as pages and notebooks: from one Python file each, in docs/tutorials."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "tutorials"


def sources() -> list[Path]:
    """The tutorials' files, in percent format (jupytext)."""
    return sorted(FOLDER.glob("*.py"))


def made() -> dict[str, bytes]:
    """Name on the site -> page or notebook."""
    import jupytext

    found: dict[str, bytes] = {}
    for source in sources():
        notebook = jupytext.read(source)
        page = [cell.source if cell.cell_type == "markdown" else _block(cell.source) for cell in notebook.cells]
        page += ["*This page drew the picture; `make tutorials` draws it again.*"]
        page += [f"[The page as a notebook]({source.stem}.ipynb)"]
        found[f"tutorials/{source.stem}.md"] = "\n\n".join(page).encode()
        found[f"tutorials/{source.stem}.ipynb"] = jupytext.writes(notebook, fmt="ipynb").encode()
    return found


def _block(source: str) -> str:
    return f"```python\n{source}\n```"
