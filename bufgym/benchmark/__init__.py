"""Fixed policies side by side: the experiment (``run``), its table (``table``), how fast it all goes (``perf``)."""
