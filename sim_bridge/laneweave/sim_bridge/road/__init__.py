"""The road and its traffic: entry of vehicles, and the process in charge of each vehicle.

Entry points: `roadside.Roadside` (connects demand queue, entry, allocation and census; `demand`
draws the arrivals), `vehicle.RoadVehicle` (one vehicle on the road), `caretakers.Caretakers`
(agents and caretakers). Imported by `sim_bridge.core`, `recording`, `baselines` and launch.
"""
