"""The live page: `laneweave watch`, of a deployment or of a recorded run.

Entry points: `process.watch_live`, `process.watch_recorded`. `live_road` (a pure core) and
`recorded_run` make the messages that `frames` defines, `server` sends them to browsers;
`templates/` is the page, which draws roads with `laneweave.launch.web`. Imported by `cli` only.
"""
