"""The command line `laneweave`: one module per group of commands.

Entry point: `entry.main`. Commands import what they need when they run. Nothing imports it but
the installed script.
"""
