"""Tutorials as pages and notebooks, each made from one Python file in docs/tutorials."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "tutorials"


def sources() -> list[Path]:
    """List the tutorials' files, in jupytext's percent format."""
    return sorted(FOLDER.glob("*.py"))


def made() -> dict[str, bytes]:
    """Map each name on the site to a page or a notebook."""
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
