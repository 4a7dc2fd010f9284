"""Parameters of a made-up link, as a fit to its recordings should find them."""

from bufgym.traces.generate.parameters import LinkParameters, OutageParameters

KNOWN = LinkParameters(
    recordings=20,
    seconds=12_000,
    quantiles_bytes_per_s=(0.6e6, 1e6, 2e6, 2.5e6, 3.2e6, 4e6, 5e6, 6e6, 6.5e6, 7.5e6, 9e6),
    place_share=0.0,
    level_share=0.7,
    level_stay_s=28.0,
    fast_memory=0.3,
    outages=OutageParameters(100, 0.5, 5.0, 120.0, 0.5, 3.0, 4.0, (0.0, 0.0, 1e5, 3e5, 4.9e5)),
)
