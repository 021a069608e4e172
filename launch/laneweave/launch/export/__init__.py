"""Recorded runs in open formats: SUMO's FCD, CSV, MCAP for Foxglove, CommonRoad.

Entry point: `formats.export`, for the command `laneweave export`. Only the command line imports
this package.
"""
