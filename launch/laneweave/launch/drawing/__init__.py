"""Figures of plans; colours and helpers shared by all figures.

Entry points: `plan` (relative coordinate system), `plan_on_road` (driven by vehicles),
`tappa_process` and `tappa_text` (explanation), `figures`, `colours`, `closed_parts`,
`road_scene`. Imported by `cli`, `report` and `watch`.
"""
