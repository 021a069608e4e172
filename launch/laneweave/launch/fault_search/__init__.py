"""Fault search: whole runs in one process and virtual time, with far more faults than occur.

Entry point: `search.search`, which runs many seeds for `laneweave simulate`. Coordinators, agents,
plan execution and caretakers are the real ones; only the road (`light_road`), the driver and the
rolling planner (`stand_ins`) are simplified. `checker` observes bodies and messages, and shares no
code with what it checks. Imported by `cli`.
"""
