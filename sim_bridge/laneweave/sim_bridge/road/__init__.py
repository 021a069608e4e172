"""The road and its traffic: where vehicles come from, who acts for them, where they are shown.

Entry points: `roadside.Roadside` (admits vehicles and publishes the census; `demand`, `entry` and
`formation_building` decide), `vehicle.RoadVehicle` (one vehicle on the road),
`attendance.Attendance` (agents and caretakers). Imported by `sim_bridge.core` and launch.
"""
