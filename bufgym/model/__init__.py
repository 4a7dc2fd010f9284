"""Terms of the model: Quantity of Information, messages and their buffer, the link, topics."""

from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.topics import Topic

__all__ = ["Link", "Topic", "qoi"]
