"""Fault search: runs in one process and virtual time, with far more faults than occur in practice.

Entry point: `search.search`, which runs many seeds for `laneweave simulate`. Coordinators, agents,
plan execution and caretakers are the real ones; only the road (`light_road`), bodies, drivers and
the rolling planner (`stand_ins`) are simplified. `checker` observes bodies and messages, and shares
no code with what it checks. Imported by `cli`.
"""
