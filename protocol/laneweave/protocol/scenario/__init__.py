"""The tables of a scenario file as frozen attrs classes, with the range of each field.

Entry point: `tables.Scenario`. Nothing here reads a file or compares tables with each other; that
is `protocol.config`. Any package may import it.
"""
