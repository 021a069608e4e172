"""Loading of scenario files, and rules between their fields.

Entry point: `loading.load_scenario`. `cross_checks` has the rules between fields, `participants`
the names of all processes. Imported by `security`, `transports` and the other packages.
"""
