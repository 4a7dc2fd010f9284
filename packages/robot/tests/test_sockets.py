"""Which of a machine's addresses are there, and what becomes of connections from one that is gone."""

import contextlib
import socket

import pytest

from bufgym_robot.wire.sockets import address_to, end_connections_from, is_gone


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0", "robot-7", "localhost", ""])
def test_an_address_that_is_here_and_a_name_are_not_gone(address: str) -> None:
    assert not is_gone(address)


@pytest.mark.parametrize("address", ["203.0.113.7", "2001:db8::7"])
def test_an_address_of_no_interface_is_gone(address: str) -> None:
    """Both are for documentation, so no machine has them (RFC 5737, RFC 3849)."""
    assert is_gone(address)


def test_where_a_connection_would_leave_from() -> None:
    assert address_to(("127.0.0.1", 9)) == "127.0.0.1"
    assert address_to(("255.255.255.255", 9)) is None  # a broadcast, which nobody may connect to


def test_connections_from_one_address_end_and_no_others() -> None:
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        ends = []
        for own in ("127.0.0.2", "127.0.0.3"):
            near = stack.enter_context(socket.create_connection(server.getsockname(), 5, (own, 0)))
            far = stack.enter_context(server.accept()[0])
            ends.append((near, far))
        (gone, gone_far), (stays, stays_far) = ends
        end_connections_from("127.0.0.2")
        assert gone.recv(1) == b"" and gone_far.recv(1) == b""
        stays.sendall(b"x")
        assert stays_far.recv(1) == b"x"
