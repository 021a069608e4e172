"""The paper's operation: formations that sort themselves by lanes, each under one ballot.

Entry points: `control.FormationControl` (the leader's rules for one formation), `planner`
(what a leader has planned for its formations), `sorting` (lane sorting, paper Section 5.2.1).
Imported by `coordinator.core`.
"""
