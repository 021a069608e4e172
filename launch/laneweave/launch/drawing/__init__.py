"""Figures of plans, and the parts that all figures share: colours and figure files.

Entry points: `plan` (relative coordinate system), `plan_on_road` (driven by vehicles),
`tappa_process` and `tappa_text` (explanation), `figures`, `colours`. Imported by `cli`, `report`
and `watch`.
"""
