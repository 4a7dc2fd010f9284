"""A relay for fleets: robots and viewers connect to it, and publish and subscribe by topic as its rules allow.

Robofleet [sikand2021robofleet] is a client on each robot, one server and a web page. This package is the server, built
on bufgym's queues. ``server.Server`` serves what ``config.Config`` allows, and ``wire`` defines the protocol on its
WebSockets.
"""
