"""Reports of finished runs: pictures as PNG, and a self-contained page.

Entry points: `report.report_run`, `report.report_comparison`; `summary_table.summary_rows` is the
table at the end of a run. `figures`, `distributions`, `path_maps` and `snapshots` draw, `animation`
prepares the animated road, `page` renders `templates/`. Imported by `run`, `cli`, benchmarks/.
"""
