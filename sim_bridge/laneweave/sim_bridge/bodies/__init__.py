"""The body of a vehicle, its motion controller and sensors; overlaps and gaps between bodies.

Entry points: `plant.Plant`, `motion_controller.MotionController`, `sensors.Sensors`,
`overlaps_and_gaps.Bodies`. Imported by the other sub-packages of `sim_bridge` and by launch.
"""
