"""Request a plan from a running coordinator; the only dependency is `eclipse-zenoh`.

Start `laneweave router --endpoint tcp/127.0.0.1:7447` and
`laneweave coordinator --endpoint tcp/127.0.0.1:7447` first. The optional argument replaces
this endpoint.
"""

import json
import sys

import zenoh

vehicles = [{"id": "left", "cell": [0, 1], "lane": 0}, {"id": "right", "cell": [0, 0], "lane": 1}]
request = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 4, "lanes": 2},
    "vehicles": vehicles,
    "targets": [[2, 0], [2, 1]],
}

config = zenoh.Config()
config.insert_json5("mode", '"client"')
endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
with zenoh.open(config) as session:
    for reply in session.get("laneweave/default/service/plan", payload=json.dumps(request)):
        answer = reply.ok or reply.err
        found = json.loads(answer.payload.to_bytes()) if answer else {}
        if reply.ok:
            print(found["status"], "cost", found["cost"])
            for vehicle, path in zip(vehicles, found["paths"], strict=True):
                print(vehicle["id"], path)
        else:
            print("no plan:", found["message"])
