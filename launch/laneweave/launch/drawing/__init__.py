"""Figures of plans; colours and helpers shared by all figures.

Entry points: `plan` (relative coordinate system), `plan_on_road` (driven by vehicles),
`tappa_process` and `tappa_text` (explanation); shared by all: `figures`, `colours`, `road_scene`,
`road_picture`. Imported by `cli`, `report` and `watch`.
"""
