"""Run a scenario, then evaluate its recording: mean speeds, and vehicles that changed lanes twice.

The optional argument is the folder of the results. Needs laneweave[plan,agent,sim].
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import laneweave

out = sys.argv[1] if len(sys.argv) > 1 else "runs/from-python"
summary = laneweave.run(transport="simulated", out=out, demand__duration_s=30.0)
print(f"{summary.vehicles.left} vehicles left, {summary.safety.overlaps} overlaps")

rows = laneweave.load_run(out).trajectories(["t_s", "vehicle", "s_m", "lane", "speed_mps"])
t_s, s_m, speed_mps = (rows[name].to_numpy() for name in ("t_s", "s_m", "speed_mps"))

# Mean speed per 50 m and minute. An entry without vehicles is NaN.
edges = [np.arange(0.0, s_m.max() + 50.0, 50.0), np.arange(0.0, t_s.max() + 60.0, 60.0)]
total, _, _ = np.histogram2d(s_m, t_s, edges, weights=speed_mps)
count, _, _ = np.histogram2d(s_m, t_s, edges)
mean_mps = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
for minute, speeds in enumerate(mean_mps.T):
    print(f"minute {minute}: {np.nanmean(speeds):.2f} m/s")

# Rows are in the order of time.
lanes: dict[object, list[object]] = {}
for vehicle, lane in zip(rows["vehicle"].to_pylist(), rows["lane"].to_pylist(), strict=True):
    if lanes.setdefault(vehicle, [lane])[-1] != lane:
        lanes[vehicle].append(lane)
print("changed lanes twice:", *(name for name, used in lanes.items() if len(used) == 3))

plt.pcolormesh(edges[1] / 60.0, edges[0], mean_mps)
plt.gca().set(xlabel="time [min]", ylabel="position [m]")
plt.colorbar(label="mean speed [m/s]")
plt.savefig(f"{out}/mean-speed.png")
