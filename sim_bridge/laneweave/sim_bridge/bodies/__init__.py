"""Bodies and what moves them: plant, motion controller, sensors, footprints and overlaps.

Entry points: `plant.Plant`, `motion_controller.MotionController`, `footprints`. Imported by `road`,
`baselines` and `recording`.
"""
