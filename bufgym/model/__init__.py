"""The model's terms: Quantity of Information (``qoi``), messages and their queue (``buffer``), the link, topics."""
