"""The paper's operation: formations that sort themselves by lanes, each under its own ballots.

Entry point: `operation.FormationsOperation` (all formations). `leader` has the rules for one of
them, `roster` the formations as the census describes them; `planner` orders lane sorting
(`sorting`, paper Section 5.2.1) and turns the results into plans, `pacing` chooses their slots.
Imported by `core` only.
"""
