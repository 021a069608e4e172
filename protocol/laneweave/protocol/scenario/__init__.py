"""The tables of a scenario file as frozen attrs classes, with the range of each field.

Entry point: `fields.Scenario`. `protocol.config` reads files and checks fields against each other.
Any package may import it.
"""
