"""A relay for fleets: robots and viewers connect out to it, publish and subscribe by topic, and rules say who may.

Robofleet [sikand2021robofleet] is a client on each robot, one server and a web page. This is the server, on
bufgym's own queues: ``server.Server`` serves what ``config.Config`` allows; ``wire`` is what goes over its WebSockets.
"""
