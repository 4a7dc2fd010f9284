"""A robot at a relay: its client with a queue, its sources, and what it does when it is driven or stopped."""
