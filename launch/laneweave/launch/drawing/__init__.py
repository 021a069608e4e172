"""Pictures of plans and what all pictures share: colours, figure files.

Entry points: `plan`, `plan_on_road`, `tappa_process`, `figures`. Imported by `cli`, `report` and
`watch`.
"""
