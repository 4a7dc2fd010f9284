"""Messages of a relay in Foxglove's WebSocket protocol (``foxglove-sdk``, extra ``foxglove``).

Foxglove and Lichtblick connect to it as to any robot. Messages of ROS go through as they are, with their definitions;
pictures become CompressedImage, and poses also transforms, so that the map shows every robot where it is.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

from bufgym.traces.formats.bag_poses import Frames
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import needs
from bufgym_relay.config import Config, Foxglove, Rule
from bufgym_relay.gate import Gate, hidden_host
from bufgym_relay.recorder import SCHEMAS
from bufgym_relay.rules import FOXGLOVE, Permissions
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire import ros_messages
from bufgym_robot.wire.place import Place
from bufgym_robot.wire.session import Session

OWN_PAGES: Final = ("https://app.foxglove.dev", "file://")  # The web page, and programs that are pages of their own
MAX_CHANNELS: Final = 10_000  # Limit on channels, which clients open by topic and type; further channels are not shown
_TRANSFORMS: Final = ("/tf", "", "")
_PICTURES: Final = ("jpeg", "png")
_ROBOT: Final = re.compile(r"/robots/([^/]+)/")


class Screen:
    """Foxglove's server; each message given to ``show`` goes to everybody connected."""

    def __init__(self, host: str, port: int, origins: Sequence[str] = ()) -> None:
        """Web pages of ``origins`` may connect, besides Foxglove's own and programs that are no page."""
        with needs("foxglove", "bufgym-relay[foxglove]", "bufgym_relay"):
            import foxglove
        self._foxglove = foxglove
        self._context = foxglove.Context()
        inside = hidden_host()  # as the library asks for no origin
        self._server = foxglove.start_server(name="bufgym relay", host=inside, port=0, context=self._context)
        try:
            self._gate = Gate(host, port, (inside, self._server.port), {*OWN_PAGES, *origins})
        except OSError as error:
            self._server.stop()
            raise BufgymError(f"{host}:{port}: Foxglove's server: {error.strerror or error}") from None
        self.address = f"{host}:{self._gate.port}"
        """Address where it listens."""
        self._channels: dict[tuple[str, str, str], Any] = {}
        self._places: dict[str, Place] = {}

    def close(self) -> None:
        """Disconnect everybody and stop."""
        self._gate.close()
        self._server.stop()

    def show(self, message: wire.Message) -> None:
        """Show one message."""
        key = message.topic, message.encoding, message.type
        if key not in self._channels:
            if len(self._channels) >= MAX_CHANNELS:
                return
            self._channels[key] = self._channel(message)
        time_ns = max(0, message.stamp_us) * 1000
        payload = bytes(message.payload)
        if message.encoding in _PICTURES:
            from foxglove.messages import CompressedImage

            frame, form = _frame(message.topic), message.encoding
            picture = CompressedImage(timestamp=_timestamp(time_ns), frame_id=frame, data=payload, format=form)
            self._channels[key].log(picture, log_time=time_ns)
            return
        self._channels[key].log(payload, log_time=time_ns)
        place = self._places.setdefault(_frame(message.topic), Place())
        with suppress(BufgymError):  # its type and its content differ
            if (pose := place.take(message.topic, payload, message.type, message.encoding)) and place.frames:
                self._transform(*pose, place.frames, message.topic, time_ns)

    def _channel(self, message: wire.Message) -> Any:
        if message.encoding in _PICTURES:
            from foxglove.channels import CompressedImageChannel

            return CompressedImageChannel(message.topic, context=self._context)
        definition = ros_messages.definition(message.type, message.encoding)
        if message.encoding == "json":
            definition = b'{"type": "object"}'
        encoding, name = message.encoding, message.type or "object"
        schema = self._foxglove.Schema(name=name, encoding=SCHEMAS.get(encoding, ""), data=definition)
        return self._foxglove.Channel(message.topic, schema=schema, message_encoding=encoding, context=self._context)

    def _transform(self, place: Any, turn: Any, frames: Frames, topic: str, time_ns: int) -> None:
        from foxglove.channels import FrameTransformChannel
        from foxglove.messages import FrameTransform, Quaternion, Vector3

        if _TRANSFORMS not in self._channels:
            self._channels[_TRANSFORMS] = FrameTransformChannel("/tf", context=self._context)
        self._channels[_TRANSFORMS].log(
            FrameTransform(
                timestamp=_timestamp(time_ns),
                parent_frame_id=frames[0] or "map",
                child_frame_id=frames[1] or _frame(topic),
                translation=Vector3(x=place.x, y=place.y, z=place.z),
                rotation=Quaternion(x=turn.x, y=turn.y, z=turn.z, w=turn.w),
            ),
            log_time=time_ns,
        )


class Bridge:
    """A screen for the messages that ``session`` receives on topics that contain ``pattern``."""

    def __init__(
        self, session: Session, port: int, host: str = "127.0.0.1", pattern: str = "^/", origins: Sequence[str] = ()
    ) -> None:
        self._screen = Screen(host, port, origins)
        self.address = self._screen.address
        self.session = session
        session.subscribe(pattern, self._screen.show)

    async def run(self) -> None:
        """Show messages until cancelled."""
        try:
            await self.session.run()
        finally:
            self._screen.close()


class Window(Screen):
    """The relay's own screen, which shows what rules with ``foxglove`` allow."""

    def __init__(self, settings: Foxglove, config: Config) -> None:
        super().__init__(settings.host, settings.port, config.origins)
        self.reruled(config.rules)

    def reruled(self, rules: Sequence[Rule]) -> None:
        """Take new rules."""
        self._permissions = Permissions(rules, FOXGLOVE)

    def __call__(self, message: wire.Message) -> None:
        """Show a message if a rule allows it."""
        if self._permissions.allow("receive", message.topic):
            self.show(message)


def _frame(topic: str) -> str:
    """Name the coordinate frame of the topic's robot."""
    match = _ROBOT.match(topic)
    return f"{match[1]}/base" if match else "base"


def _timestamp(time_ns: int) -> Any:
    from foxglove.messages import Timestamp

    return Timestamp(sec=min(time_ns // 10**9, 2**32 - 1), nsec=time_ns % 10**9)
