"""The evaluation: from finished runs to the tables and figures of docs/EVALUATION_*.md.

programme        methods and volumes; goals
lattice_points   distances between vehicles at the fixed time points of the lattice
points           results of each run, and of each label and volume over its seeds
intervals, comparisons
                 confidence intervals; formation control against each reference method
trials           single runs: over Zenoh (and their agreement with simulated ones), for
                 real-time factors, on a long road
evidence         the JSON file of all results
tables, goals, statements
                 results as Markdown
pictures         figures

`benchmarks/evaluate.py` runs everything; `docs/generate.py` writes the tables into the document.
"""
