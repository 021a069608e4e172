"""Faults of a run: what a faults file may say, when each fault is due, and how it is done.

Entry points: `specification.load_faults`, `injection`. `presets/` holds the named fault files.
Imported by `run` and `cli`.
"""
