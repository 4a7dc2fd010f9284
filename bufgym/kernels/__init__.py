"""Kernels as C: plain Python functions over arrays, each translated once for each set of kinds of its arguments."""
