"""Radio channels: which messages vehicles and coordinators lose, by distance and load.

Entry point: `radio_core.over_radio`, which wraps the core of a process. `reception` has the
published models of the sidelink. The process modules and `launch` import it.
"""
