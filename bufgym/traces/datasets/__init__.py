"""Public data sets: the table of them, and how `bufgym trace fetch` downloads, verifies and unpacks their files.

`datasets.toml` says what each holds, `SHA256SUMS` how its files are verified; `table` reads both. `fetch` keeps the
cache folder with pooch, and `unpack` opens archives safely.
"""

from bufgym.traces.datasets.fetch import Fetched, cache_folder, fetch_dataset
from bufgym.traces.datasets.table import Dataset, Remote, datasets

__all__ = ["Dataset", "Fetched", "Remote", "cache_folder", "datasets", "fetch_dataset"]
