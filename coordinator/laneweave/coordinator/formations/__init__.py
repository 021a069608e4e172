"""The paper's operation: formations that sort themselves by lanes, each under its own ballots.

Entry point: `operation.FormationsOperation` (all formations). `leader` has the rules for one
formation, `roster` derives formations from the census, `formation_planner` requests lane sorting
(`sorting`, paper Section 5.2.1) and turns results into plans, `pacing` chooses their slots.
Imported by `core` only.
"""
