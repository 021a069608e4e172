"""The road and its traffic: where vehicles enter, and which process acts for each of them.

Entry points: `roadside.Roadside` (admits vehicles and publishes the census; `demand`, `entry` and
`formation_building` decide), `vehicle.RoadVehicle` (one vehicle on the road),
`attendance.Attendance` (agents and caretakers). Imported by `sim_bridge.core`, `recording`,
`baselines` and launch.
"""
