"""A rospy node that registers anew once its machine has another address.

ROS 1's master tells subscribers the address that a node had when it registered. So nobody finds a robot that comes into
another network, until its nodes are started again. A node whose address is announced by name (ROS_HOSTNAME) is left
alone. The master must be reachable from the new address.
"""

import functools
import os
import sys
import threading
import time
import xmlrpc.client
from typing import Any, Final
from urllib.parse import urlsplit

from bufgym_robot.wire.sockets import address_to, end_connections_from, is_gone

_LOOK_S: Final = 0.5  # Time between two looks at the address
_PATIENCE_S: Final = 1.0  # Time for the master to answer


@functools.cache
def watch() -> None:
    """Once in a process: look at this machine's address from now on, in a thread that lasts as long as the process."""
    threading.Thread(target=_watch, name="bufgym: address", daemon=True).start()


def _watch() -> None:
    import rosgraph
    import rospy

    said = ""
    while not rospy.core.is_shutdown_requested():
        time.sleep(_LOOK_S)
        uri, master = rospy.get_node_uri(), rosgraph.get_master_uri()
        old, place = urlsplit(uri or "").hostname, urlsplit(master)
        if not old or not is_gone(old):
            continue
        new = address_to((place.hostname, place.port))
        if new is None:  # no way leads to the master yet
            continue
        end_connections_from(old)
        try:
            _register_anew(uri, old, new, xmlrpc.client.ServerProxy(master, _Soon()))
            rospy.logwarn("bufgym: this machine's address has become %s; registered anew", new)
        except Exception as error:  # of many kinds; it is tried again
            if new != said:  # not by rospy's log, which asks the master without a limit in time
                text = f"this machine's address has become {new}, and the master has not heard of it: {error}"
                print(f"bufgym_robot.ros1: {text}", file=sys.stderr)
            said = new


class _Soon(xmlrpc.client.Transport):
    """A transport that does not wait for minutes."""

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = _PATIENCE_S
        return connection


def _register_anew(uri: str, old: str, new: str, master: Any) -> None:
    """Tell the master that this node, known as ``uri``, is at ``new``.

    All that is registered under the old URI is taken off first. A master that knows one node by two URIs tells the one
    at the old address to end, and by now that may be another robot.
    """
    import rospy
    from rospy.impl.registration import get_registration_listeners, get_service_manager, get_topic_manager

    name, new_uri = rospy.get_name(), uri.replace(old, new, 1)
    topics, services = get_topic_manager(), get_service_manager()
    published, subscribed = topics.get_publications(), topics.get_subscriptions()
    # An earlier try may have come half way, and found services with their new URIs.
    before = {service: at.replace(new, old, 1) for service, at in services.get_services()}
    for topic, _ in published:
        master.unregisterPublisher(name, topic, uri)
    for topic, _ in subscribed:
        master.unregisterSubscriber(name, topic, uri)
    for service, at in before.items():
        master.unregisterService(name, service, at)

    # Where subscribers are told to connect to; rospy looks for it in this order.
    sys.argv[:] = [word for word in sys.argv if not word.startswith(("__ip:=", "__hostname:="))]
    os.environ.pop("ROS_HOSTNAME", None)
    os.environ["ROS_IP"] = new
    for service in services.map.values():
        service.uri = service.uri.replace(old, new, 1)
    managers = [one for one in get_registration_listeners().listeners if hasattr(one, "publisher_update")]
    for manager in managers:
        manager.uri = manager.handler.uri = new_uri
    for topic, kind in published:
        master.registerPublisher(name, topic, kind, new_uri)
    for topic, kind in subscribed:
        publishers = master.registerSubscriber(name, topic, kind, new_uri)[2]
        for manager in managers:
            manager.publisher_update(topic, publishers)
    for service, at in services.get_services():
        master.registerService(name, service, at, new_uri)
    rospy.core.set_node_uri(new_uri)  # at last: until then it is tried again
