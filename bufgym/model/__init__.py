"""Terms of the model: Quantity of Information, messages and their buffer, the link, topics."""

from typing import TYPE_CHECKING

from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym.model import observe, qoi
    from bufgym.model.buffer import Buffer
    from bufgym.model.link import Link
    from bufgym.model.qoi import Value
    from bufgym.model.topics import Topic

__all__ = ["Buffer", "Link", "Topic", "Value", "observe", "qoi"]

__getattr__ = on_demand(
    __name__,
    {"observe": "observe", "qoi": "qoi", "Buffer": "buffer", "Link": "link", "Value": "qoi", "Topic": "topics"},
)
