"""Reports of finished runs: figures as PNG, and one page that needs nothing else.

runs                  which folders hold which runs
tracks                a run's trajectories as arrays
distributions         spacings, headways, decelerations, ...: counts over a run
styling               colours of labels, small panels
comparison_figures    travel times, throughput, shares, speeds: labels side by side
distribution_figures  what `distributions` counts
path_maps             the relative path map of a formation, and its figure
animation             the moving road: compact data for the player
tables                tables of a page
page                  the page: `templates/`
make                  all of it, of one run or of many
"""
