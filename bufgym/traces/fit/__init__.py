"""Fit the parameters of `generate.markov` to recordings, and compare recordings with links from the fit.

`fit` finds the parameters, `statistics` has the statistics of recordings, `compare` tests each against its distribution
under the model, and `page` writes the comparison down (docs/generators.md).
"""
