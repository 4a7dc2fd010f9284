"""Studies: each answered one question or made some numbers, and is run again only to check them. See README.md."""
