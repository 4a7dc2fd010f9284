"""Links and motions generated from a seed; the parameters of `markov_link` are fitted to recordings.

trace = markov_link("tram", seed=3)                    # fitted to recordings made in trams
motion = drive_motion(seed=3)
"""
