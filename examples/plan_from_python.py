"""Plan in this process: four vehicles swap their lanes. Needs laneweave."""

import laneweave

request = laneweave.PlanRequest.from_dict(
    {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": 4, "lanes": 2, "blocked": [[3, 0]]},
        "vehicles": [
            {"id": "red", "cell": [0, 0], "lane": 1},
            {"id": "green", "cell": [0, 1], "lane": 0},
            {"id": "blue", "cell": [1, 0], "lane": 1},
            {"id": "black", "cell": [1, 1], "lane": 0},
        ],
        "targets": [[1, 0], [1, 1], [2, 0], [2, 1]],
    }
)

# Or the name of a planner of your own, such as examples/planner-plugin.
plan = laneweave.plan(request, solver="tappa", deadline_s=2.0)

print(f"{plan.status}: cost {plan.cost}, {plan.steps} steps, {plan.solve_ms:.1f} ms")
print(plan.path_map(request.ids))
for vehicle, target, path in zip(request.ids, plan.assignment, plan.paths, strict=True):
    print(vehicle, "takes target", target, "by", *path)
