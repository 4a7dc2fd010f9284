"""Public data sets: the table of them, and how `bufgym trace fetch` downloads, verifies and unpacks their files.

`datasets.toml` says what each holds, `SHA256SUMS` how its files are verified; `table` reads both. `fetch` keeps the
cache folder with pooch, and `unpack` opens archives safely.
"""
