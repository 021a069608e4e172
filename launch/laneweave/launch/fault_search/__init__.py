"""Fault search: runs in one process and virtual time, with far more faults than occur in practice.

Entry point: `search.search`, which runs many seeds for `laneweave simulate`. Coordinators, agents
and the bridge's `SimulatedRoad` are the real ones; only bodies (`light_vehicle`), drivers and the
rolling planner (`stand_ins`) are simplified, and ticks wait for no answers (`light_road`).
`checker` observes bodies and messages, and shares no code with what it checks. Imported by `cli`.
"""
