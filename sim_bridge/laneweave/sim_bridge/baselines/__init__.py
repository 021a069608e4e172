"""Reference methods: the same demand on the same road, without formations, agents or messages.

    rule.py      the paper's rule-based method (Section 5.2.2)
    lc2013.py    SUMO's own lane changing and car following

Both move vehicles as a `Traffic`, which `road.py` steps, measures and records as in other runs.
"""
