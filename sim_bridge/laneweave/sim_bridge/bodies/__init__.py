"""One vehicle's body and what moves it; overlaps and gaps of bodies.

Entry points: `plant.Plant`, `motion_controller.MotionController`, `sensors.Sensors`,
`overlaps_and_gaps.Bodies`. Imported by the other sub-packages of `sim_bridge` and by launch.
"""
