"""Studies of settings: `laneweave tune` and `laneweave sensitivity`.

Entry points: `tuning.draw_sets`, `tuning.score_of`, `sensitivity.factors_of`,
`sensitivity.result_of`, `study_runs.finished_runs`. The command line imports them.
"""
