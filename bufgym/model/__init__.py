"""Terms of the model: Quantity of Information, messages and their buffer, the link, topics."""
