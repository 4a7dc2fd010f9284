"""Messages that each wait for something of their own: they wait together and are handed on in order."""

import asyncio

import pytest
from loop_cases import beside, until

from bufgym_robot import PolicyQueue
from bufgym_robot.ahead import Ahead
from bufgym_robot.channels import TcpChannel
from bufgym_robot.frames import DATA, Frame
from bufgym_robot.receiver import Received, Receiver
from bufgym_robot.sender import Sender


async def test_what_waits_behind_the_first_is_expected_meanwhile() -> None:
    """Nothing is handed on or acked before the first is; then all are, in order."""
    gate, expected, came = asyncio.Event(), list[bytes](), list[bytes]()

    async def take(message: Received) -> None:
        await gate.wait()
        came.append(bytes(message.body))

    receiver = Receiver(take, expect=lambda body: expected.append(bytes(body)))
    port = await receiver.listen()
    queue = PolicyQueue("drop-oldest", 8)
    bodies = [b"%d" % k for k in range(5)]
    async with beside(Sender(queue, lambda: TcpChannel.connect("127.0.0.1", port)).run()):
        for body in bodies:
            queue.put(body, len(body))
        await until(lambda: expected == bodies[1:])
        assert came == []
        gate.set()
        await until(lambda: came == bodies)
    await receiver.close()
    assert queue.dropped == 0


class Lasting:
    """A channel with frames of 100 kB without end, until it breaks."""

    def __init__(self, breaks_after: int) -> None:
        self.received, self._breaks_after = 0, breaks_after

    async def receive(self) -> Frame:
        if self.received == self._breaks_after:
            raise ConnectionResetError("the peer has closed the connection")
        self.received += 1
        return Frame(DATA, self.received, body=bytes(100_000))


@pytest.mark.parametrize(("breaks_after", "received"), [(1000, 11), (3, 3)])
async def test_little_is_received_ahead_and_a_break_is_told_in_its_turn(breaks_after: int, received: int) -> None:
    """A megabyte at most; the work that waits is done although the connection has broken meanwhile."""
    channel = Lasting(breaks_after)
    async with Ahead(channel, lambda body: None) as frames:  # type: ignore[arg-type]
        await frames.during(asyncio.sleep(0.05))
        assert channel.received == received
        assert [(await frames.receive()).number for _ in range(received)] == list(range(1, received + 1))
        if breaks_after == received:
            with pytest.raises(ConnectionResetError):
                await frames.receive()
