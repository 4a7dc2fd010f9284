"""Studies of ours around the papers: each answered one question, and is run again only to check the answer."""
