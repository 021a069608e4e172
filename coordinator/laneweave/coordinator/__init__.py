"""Election, formation building, planning, and the coordinator process."""
