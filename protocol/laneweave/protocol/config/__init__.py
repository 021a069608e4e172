"""Loading and cross-field checks of scenario files.

Entry point: `scenario_files.load_scenario`. modules `*_checks` check fields against each other,
`participants` names all processes. Imported by `security` and the other packages.
"""
