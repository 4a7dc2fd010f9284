"""The list of papers, data sets and systems, from docs/references.bib."""

import re
from pathlib import Path

BIB = Path(__file__).resolve().parent.parent / "docs" / "references.bib"


def page() -> str:
    """The whole page."""
    lines = ["# Papers, data sets and systems", "[Claims of the papers with our numbers](results/claims.md)"]
    for part in re.split(r"^% --- ", BIB.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        title, _, entries = part.partition("\n")
        lines += [f"## {title[0].upper()}{title[1:]}"]
        lines += [_entry(key, body) for key, body in re.findall(r"@\w+\{([^,\s]+),\n(.*?)\n\}", entries, re.DOTALL)]
    return "\n\n".join(lines)


def _entry(key: str, body: str) -> str:
    fields = re.findall(r"^  (\w+)\s*=\s*\{(.*?)\}(?:,?$)(?=\n  \w+\s*=|\Z)", body, re.DOTALL | re.MULTILINE)
    found = {name: _plain(" ".join(text.split())) for name, text in fields}  # a field may take several lines
    who = found.get("author", found.get("organization", "")).replace(" and ", ", ")
    where = found.get("booktitle") or found.get("journal") or found.get("howpublished") or found.get("publisher") or ""
    links = []
    if "doi" in found:
        links.append(f"[doi:{found['doi']}](https://doi.org/{found['doi']})")
    if found.get("archiveprefix") == "arXiv":
        links.append(f"[arXiv:{found['eprint']}](https://arxiv.org/abs/{found['eprint']})")
    if "url" in found:
        links.append(f"<{found['url']}>")
    facts = [who, f"*{found.get('title', key)}*", where, found.get("year", ""), found.get("note", ""), *links]
    return f'<a id="{key}"></a>**{key}**: ' + ". ".join(fact for fact in facts if fact) + "."


def _plain(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", re.sub(r"[{}]", "", text)).replace("~", " ").replace("--", "-")
