"""Reference methods: the same demand on the same road, without formations, agents or messages.

`rule_based` is the paper's rule-based method (Section 5.2.2), `lc2013` SUMO's own lane changing and
car following. Entry point: `reference_road.ReferenceRoad`, which steps, measures and records either
of them as a `Traffic`. Imported by launch.
"""
