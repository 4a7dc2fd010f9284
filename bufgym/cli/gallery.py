"""``bufgym gallery``: films of the environments, policies side by side, and the interactive page."""

from __future__ import annotations

import argparse
from pathlib import Path

from bufgym.cli.options import Commands, columns, command
from bufgym.errors import BufgymError


def add(commands: Commands) -> None:
    parser = command(commands, "gallery", _gallery, "films of the environments, policies side by side")
    parser.add_argument("names", nargs="*", metavar="NAME", help="which films; 'all' for all; none lists them")
    parser.add_argument("--out", default="gallery", metavar="DIR", help="where films go (%(default)s)")
    parser.add_argument("--interactive", metavar="FILE", help="write the interactive page (HTML)")


def _gallery(options: argparse.Namespace) -> None:
    from bufgym import gallery
    from bufgym.files import replaced

    if options.interactive is not None:
        target = Path(options.interactive)
        if not target.parent.is_dir() or (target.exists() and not target.is_file()):
            raise BufgymError(f"{target}: must be a file in a folder that exists (--interactive)")
        page = gallery.page()
        with replaced(target) as temporary:
            temporary.write_text(page, encoding="utf-8")
        print(f"wrote {options.interactive}")
    elif not options.names:
        films = [(name, film.environment, film.about) for name, film in gallery.FILMS.items()]
        print("films (bufgym gallery NAME..., or all)\n" + columns(films))
    names = list(gallery.FILMS) if "all" in options.names else list(dict.fromkeys(options.names))
    for name in names:
        path = gallery.write_film(name, Path(options.out))
        print(f"wrote {path} ({path.stat().st_size / 1000:.0f} kB)", flush=True)
