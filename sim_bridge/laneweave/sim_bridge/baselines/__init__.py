"""Reference methods: the same demand and road, without formations, agents or messages.

`rule_based` is the paper's rule-based method (Section 5.2.2), `lc2013` is SUMO's own lane changing
and car following; users add others (`reference_method.ReferenceMethod`). Entry point:
`reference_road.ReferenceRoad`, which runs, measures and records any of them as a `Traffic`.
Imported by launch.
"""
