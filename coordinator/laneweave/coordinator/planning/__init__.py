"""Target assignment and path planning in the relative coordinate system.

Entry points: `solve.plan` answers a `request.PlanRequest` with a `response.PlanResponse`;
`rolling.path_search.StreamPlanner` plans a stream. Imported by the rest of the coordinator and by
launch; imports the protocol only. Pure: no I/O, no state between calls, and time only from the
clock that is passed in.

| paper | module |
|---|---|
| relative motion modes 1 and 2 | `protocol.lattice`, `grid.Grid` |
| conflict kinds | `conflict_kinds` |
| formation relative distance, matrices C and P, assignments by cost | `paper.assignments` |
| TAPPA, Algorithm 1 | `paper.tappa` |
| CBSA, Algorithm 2 | `paper.cbs` |
| conflicts and constraints of the tree | `paper.constraints` |
| SPPA | `shortest_paths` |
| relative path map | `path_map` |
| parallel and interlaced structure | `formation_structures` |

Additions: improvements to TAPPA (`paper.cbs.Improvements`), a record of its run
(`paper.explanation`), branch and bound and a joint search (`exact`), one vehicle after another
(`prioritized`), the planner for rolling operation (`rolling`), and conflicts computed from sizes
and motions (`geometry`).
"""
