"""The road and its traffic: entry of vehicles, and the process in charge of each vehicle.

Entry points: `roadside.Roadside` (admits vehicles with `demand`, `entry` and `formation_building`;
publishes the census), `vehicle.RoadVehicle` (one vehicle on the road), `attendance.Attendance`
(agents and caretakers). Imported by `sim_bridge.core`, `recording`, `baselines` and launch.
"""
