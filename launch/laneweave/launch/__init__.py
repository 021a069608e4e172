"""The command line, the local process supervisor, and reports."""
