"""Explanations: what happened to a vehicle in a recorded run, and why it missed its lane.

`facts` collects what the events say about the vehicle, `reasons` derives the reason, `story` puts
the events into words. `explanation.explain` does all three.
"""
