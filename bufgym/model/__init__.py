"""Terms of the model: Quantity of Information, messages and their buffer, the link, topics."""

from typing import TYPE_CHECKING

from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym.model.buffer import Buffer
    from bufgym.model.link import Link

__all__ = ["Buffer", "Link"]

__getattr__ = on_demand(__name__, {"Buffer": "buffer", "Link": "link"})
