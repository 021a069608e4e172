"""The evaluation: what docs/EVALUATION.md reports, from finished runs to its tables and figures.

programme        which methods at which volumes; the goals
lattice_points   how far apart vehicles are at the fixed time points of the lattice
points           one row for each label and volume, over its seeds
trials           single runs: over Zenoh (and their agreement with simulated ones), for
                 real-time factors, on a long road
evidence         all of it in one JSON file
tables, goals, statements
                 from the file to Markdown
pictures         the figures

`benchmarks/evaluate.py` runs it all; `docs/generate.py` puts the tables into the document.
"""
