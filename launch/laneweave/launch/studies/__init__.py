"""Studies of settings: `laneweave tune` and `laneweave sensitivity`.

Entry points: `tuning.draw_sets`, `tuning.score_of`, `sensitivity.factors_of`,
`sensitivity.result_of`. Their runs are points of a sweep (`variants`). The command line imports it.
"""
