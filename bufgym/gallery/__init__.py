"""Pictures of bufgym at work: each environment as a short film, policies side by side, and the interactive page.

Every picture has a fixed episode, so that ``bufgym gallery`` draws the same ones again.
"""

from bufgym.gallery.comparison import save
from bufgym.gallery.films import FILMS, write_film
from bufgym.gallery.interactive import page, page_data
from bufgym.gallery.played import Played, fading, play

__all__ = ["FILMS", "Played", "fading", "page", "page_data", "play", "save", "write_film"]
