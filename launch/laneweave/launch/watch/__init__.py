"""`laneweave watch`: the live page of a deployment or of a recorded run.

Entry points: `process.watch_live`, `process.watch_recorded`. `live_road` (a pure core) and
`recorded_run` produce the messages that `frames` defines; `server` sends them to browsers. The page
in `templates/` draws roads with `laneweave.launch.web`. Imported by `cli` only.
"""
