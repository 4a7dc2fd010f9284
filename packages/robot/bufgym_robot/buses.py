"""Publish-subscribe libraries that frames may go over: Zenoh and MQTT.

| name | library | the receiver | host and port |
|---|---|---|---|
| zenoh | ``eclipse-zenoh`` | listens, a peer of Zenoh over TCP | where the receiver listens |
| mqtt | ``paho-mqtt`` | connects, as the sender does | the broker's |

Both send and receive reliably, and drop nothing themselves.
"""

import contextlib
import json
import threading
import time
from typing import Any, Final

from bufgym.utils.libraries import needs
from bufgym_robot.bus_channel import Hear, Open, Peer
from bufgym_robot.wire.sockets import DEAD_AFTER_S, host_port

ROOT: Final = "bufgym"
MQTT_PORT: Final = 1883  # Standard port of an MQTT broker
CONNECT_S: Final = 1.0  # Time for a Zenoh receiver to answer


class ZenohBus:
    """A Zenoh session. Its full queue blocks the sender; by default it would drop."""

    def __init__(self, host: str, port: int, name: str, hear: Hear, peer: Peer) -> None:
        with needs("zenoh", "bufgym-robot[zenoh]"):
            import zenoh
        self._zenoh, self._name = zenoh, name
        config = zenoh.Config()
        for key, setting in {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "listen/endpoints": [] if name else [f"tcp/{host_port(host, port)}"],
            "connect/endpoints": [f"tcp/{host_port(host, port)}"] if name else [],
            "connect/timeout_ms": round(CONNECT_S * 1000),
            "connect/exit_on_failure": True,
            "transport/shared_memory/enabled": False,  # on one machine it would carry bodies past the link
            "transport/link/tx/lease": round(DEAD_AFTER_S * 1000),
            "transport/link/tx/queue/congestion_control/block/wait_before_close": round(DEAD_AFTER_S * 1e6),
        }.items():
            config.insert_json5(key, json.dumps(setting))
        try:
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            raise ConnectionError(f"zenoh, {host}:{port}: {error}") from None
        heard = f"{ROOT}/down/{name}" if name else f"{ROOT}/up/*"
        self._session.declare_subscriber(
            heard, lambda sample: hear(str(sample.key_expr).rsplit("/", 1)[1], sample.payload.to_bytes())
        )
        live = self._session.liveliness()
        if name:
            live.declare_subscriber(
                f"{ROOT}/receiver", lambda sample: peer(sample.kind == zenoh.SampleKind.PUT), history=True
            )
        else:
            self._token = live.declare_token(f"{ROOT}/receiver")

    def publish(self, name: str, data: bytes) -> None:
        zenoh, way = self._zenoh, "up" if self._name else "down"
        try:
            self._session.put(
                f"{ROOT}/{way}/{name}", data, congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
        except zenoh.ZError as error:
            raise ConnectionError(f"zenoh: {error}") from None

    def close(self) -> None:
        self._session.close()


class MqttBus:
    """A client of an MQTT broker. A retained message announces the receiver, and the broker's will its end."""

    def __init__(self, host: str, port: int, name: str, hear: Hear, peer: Peer) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        self._name, presence, self._closed = name, f"{ROOT}/receiver", False
        self._client = Client(CallbackAPIVersion.VERSION2, reconnect_on_failure=not name)
        joined, refused = threading.Event(), list[bool]()

        def on_connect(client: Client, *_: Any) -> None:
            client.subscribe([(f"{ROOT}/down/{name}", 0), (presence, 0)] if name else f"{ROOT}/up/+")
            if not name:
                client.publish(presence, b"here", qos=1, retain=True)

        def on_message(_: Client, __: Any, message: Any) -> None:
            if message.topic == presence:
                peer(bool(message.payload))
            else:
                hear(message.topic.rsplit("/", 1)[1], message.payload)

        def on_disconnect(*_: Any) -> None:
            peer(False)
            if not joined.is_set():
                refused.append(True)
            joined.set()

        self._client.on_connect = on_connect
        self._client.on_message = on_message
        self._client.on_subscribe = lambda *_: joined.set()
        self._client.on_disconnect = on_disconnect
        if not name:
            self._client.will_set(presence, b"", qos=1, retain=True)
        self._presence = presence
        self._client.connect(host, port, keepalive=round(DEAD_AFTER_S))
        self._client.loop_start()
        if not joined.wait(DEAD_AFTER_S) or refused:
            self.close()
            raise ConnectionError(f"mqtt, {host}:{port}: the broker does not answer")

    def publish(self, name: str, data: bytes) -> None:
        way = "up" if self._name else "down"
        until_s = time.monotonic() + DEAD_AFTER_S
        try:
            message = self._client.publish(f"{ROOT}/{way}/{name}", data)
            while not (message.is_published() or self._closed or time.monotonic() > until_s):
                message.wait_for_publish(0.05)
        except (RuntimeError, ValueError) as error:  # no connection
            raise ConnectionError(f"mqtt: {error}") from None

    def close(self) -> None:
        self._closed = True
        if not self._name:
            with contextlib.suppress(RuntimeError):
                self._client.publish(self._presence, b"", qos=1, retain=True).wait_for_publish(1)
        self._client.disconnect()
        self._client.loop_stop()


BUSES: Final[dict[str, Open]] = {"zenoh": ZenohBus, "mqtt": MqttBus}  # Name of a library -> class that opens either end
