"""The live page: `laneweave watch`, of a deployment or of a recorded run.

live_road   messages in, frames out: the pure core (with loss, candidates, news)
recorded    the frames of a run's folder
frames      what goes over the websocket: the one place that says so
ring        the last minutes
server      the page, its websocket, /healthz
process     sockets, signals, the thread that listens to the network
templates/  the page itself; how roads are drawn is in `laneweave.launch.web`
"""
