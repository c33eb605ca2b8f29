"""Messages on their way: UDP and a websocket on this machine."""

import json
import socket
import time

import numpy as np
import pytest
from websockets.sync.client import connect

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.live.messages import message_of
from poem_jax.capture.live.streams import UdpStream, WebsocketStream, check_port_is_free, parse_receiver
from poem_jax.hand.topology import NUM_JOINTS


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def message(number):
    joints = np.full((NUM_JOINTS, 3), 0.1234567 + number)
    seen = HandResult(np.ones(4, bool), joints_world=joints, joint_sigma_m=np.full(NUM_JOINTS, 0.002))
    hands = (seen, HandResult(np.zeros(4, bool), "unseen"))
    return message_of(Frame(f"{number:06d}", np.full((2, 4, 4), np.nan), hands=hands, time_s=number / 30))


def test_what_is_received_by_udp_is_the_message():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(20)
        stream = UdpStream("127.0.0.1", receiver.getsockname()[1])
        for number in range(3):
            stream.send(message(number))
        stream.close()
        got = [json.loads(receiver.recv(65535)) for _ in range(3)]
    assert [one["moment"] for one in got] == [0, 1, 2]
    assert got[2]["time_s"] == 0.0667
    right, left = got[2]["hands"]["right"], got[2]["hands"]["left"]
    assert right == {
        "valid": True,
        "bridged": False,
        "joints_world": [[2.12346] * 3] * NUM_JOINTS,
        "sigma_m": [0.002] * NUM_JOINTS,
    }
    assert left == {"valid": False, "bridged": False, "joints_world": None, "sigma_m": None}


def test_nobody_needs_to_listen():
    stream = UdpStream("127.0.0.1", free_port())
    for number in range(20):
        stream.send(message(number))
    stream.close()


def test_a_client_of_the_websocket_gets_the_newest_only():
    """However slowly it reads: what it gets grows, and ends with the last message."""
    port = free_port()
    stream = WebsocketStream("127.0.0.1", port)
    stream.send(message(0))
    with connect(f"ws://127.0.0.1:{port}") as client:
        got = []
        deadline = time.monotonic() + 30
        for number in range(1, 200):
            stream.send(message(number))
        while not got or got[-1] < 199:
            stream.send(message(199))
            got.append(json.loads(client.recv(timeout=20))["moment"])
            assert time.monotonic() < deadline
        assert got == sorted(got)
    stream.close()
    check_port_is_free("127.0.0.1", port, "--websocket")


def test_a_client_that_leaves_ends_nothing(caplog):
    port = free_port()
    stream = WebsocketStream("127.0.0.1", port)
    with connect(f"ws://127.0.0.1:{port}"):
        pass
    for number in range(5):
        stream.send(message(number))
    with connect(f"ws://127.0.0.1:{port}") as client:
        stream.send(message(7))
        while json.loads(client.recv(timeout=20))["moment"] != 7:
            stream.send(message(7))
    stream.close()
    assert not [record for record in caplog.records if record.levelname in ("WARNING", "ERROR")]


def test_a_port_in_use_is_one_clear_error():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(
            ValueError, match=rf"port {port} of 127.0.0.1 cannot be used .* another --websocket"
        ):
            WebsocketStream("127.0.0.1", port)
    with pytest.raises(ValueError, match="--viewer must be a port from 1 to 65535; got 70000"):
        check_port_is_free("127.0.0.1", 70000, "--viewer")


@pytest.mark.parametrize("text", ["9000", "host:", ":9000", "host:x", "host:0", "host:65536"])
def test_receivers_that_are_none(text):
    with pytest.raises(ValueError, match=r"--udp must be HOST:PORT, as 127\.0\.0\.1:9000"):
        parse_receiver(text)


def test_receivers():
    assert parse_receiver("localhost:9000") == ("localhost", 9000)
    assert parse_receiver("[::1]:9000") == ("::1", 9000)
    with pytest.raises(ValueError, match="the host 'no such host' has no address"):
        UdpStream("no such host", 9000)
