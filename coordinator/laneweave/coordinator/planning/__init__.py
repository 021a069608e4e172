"""Target assignment and path planning in the relative coordinate system.

Entry points: `facade.plan` answers one `request.PlanRequest` with a `response.PlanResponse`;
`rolling.planner.StreamPlanner` plans a whole stream. Imported by the rest of the coordinator and by
launch; imports the protocol only. Pure: no I/O, no state between calls, and time only through the
clock that is passed in.

Where the parts of the paper are:

| paper | module |
|---|---|
| relative motion modes 1 and 2 | `protocol.lattice`, `grid` |
| conflict model | `conflicts` |
| formation relative distance, cost matrix C | `paper.assignments` |
| preference matrix P | `paper.assignments` |
| assignments in non-decreasing order of cost | `paper.assignments` |
| TAPPA, Algorithm 1 | `paper.tappa` |
| CBSA, Algorithm 2 | `paper.cbs` |
| conflicts and constraints of the tree | `paper.constraints` |
| SPPA | `shortest_paths` |
| relative path map | `path_map` |
| parallel and interlaced structure | `structures` |

Beyond the paper: improvements of TAPPA (`paper.cbs.Improvements`, `paper.joint_search`), a record
of its run (`paper.explanation`), branch and bound (`exact`), the rolling planner (`rolling`), and
conflicts computed from sizes and motions (`geometry`).
"""
