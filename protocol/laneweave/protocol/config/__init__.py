"""Reading a scenario file and checking its tables against each other.

Entry point: `loading.load_scenario`. `checks` has the rules between fields, `identities` the names
of all processes of a deployment. Imported by `security`, `transports` and the other packages.
"""
