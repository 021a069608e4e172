"""The tables of a scenario file as frozen attrs classes, and what follows from them.

Entry point: `fields.Scenario`, whose properties lead to derived figures. `protocol.config` reads
files and checks fields against each other. Any package may import it.
"""
