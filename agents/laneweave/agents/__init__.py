"""The vehicle agent: plan execution, trajectory planning and tracking."""
