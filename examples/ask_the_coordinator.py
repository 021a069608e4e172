"""Request a plan from a running coordinator: three vehicles, each with a preferred lane.

Start `laneweave router --endpoint tcp/127.0.0.1:7447` and
`laneweave coordinator --endpoint tcp/127.0.0.1:7447` first. The optional argument replaces
this endpoint.
"""

import sys

import laneweave

request = laneweave.PlanRequest.from_dict(
    {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": 6, "lanes": 3},
        "vehicles": [
            {"id": "red", "cell": [0, 0], "lane": 2},
            {"id": "green", "cell": [1, 1], "lane": 0},
            {"id": "blue", "cell": [2, 2], "lane": 1},
        ],
        "targets": [[2, 0], [2, 1], [3, 2], [3, 0]],
        "deadline_s": 2.0,
    }
)

endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
with laneweave.PlanClient(endpoint) as client:
    try:
        plan = client.plan(request, timeout_s=5.0)
    except (laneweave.PlanError, TimeoutError) as error:
        raise SystemExit(f"no plan: {error}") from None

print(f"{plan.status}: cost {plan.cost}, {plan.steps} steps, {plan.solve_ms:.1f} ms")
print(plan.path_map(request.ids))
