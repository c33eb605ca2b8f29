"""Where messages go: by UDP to one receiver, by a websocket to whoever connects. Nobody is waited for."""

import contextlib
import logging
import socket
import threading

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

_MAX_PORT = 65535
_CLOSE_S = 2.0

_log = logging.getLogger(__name__)


def parse_receiver(text: str, option: str = "--udp") -> tuple[str, int]:
    """Return host and port of `HOST:PORT`.

    Raises:
        ValueError: It is not of this form.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) <= _MAX_PORT:
        raise ValueError(f"{option} must be HOST:PORT, as 127.0.0.1:9000; got {text!r}")
    return host.strip("[]"), int(port)


def check_port_is_free(host: str, port: int, option: str) -> None:
    """Insist that a server can listen there.

    Raises:
        ValueError: It cannot; names the `option` that chooses the port.
    """
    if not 0 < port <= _MAX_PORT:
        raise ValueError(f"{option} must be a port from 1 to {_MAX_PORT}; got {port}")
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"port {port} of {host} cannot be used ({reason}): give another {option}") from error


class UdpStream:
    """Sends each message as one datagram; whether it arrives is not known."""

    def __init__(self, host: str, port: int) -> None:
        """Prepare it.

        Raises:
            ValueError: The host has no address.
        """
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise ValueError(f"--udp: the host {host!r} has no address: {error}") from error
        family, kind, protocol, _, self._address = found[0]
        self._socket = socket.socket(family, kind, protocol)
        self._told = False

    def send(self, message: str) -> None:
        """Send a message; the first that cannot be sent is told."""
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError as error:
            if not self._told:
                self._told = True
                _log.warning("messages to %s cannot be sent: %s", self._address, error)

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


class WebsocketStream:
    """A server that sends each client the newest message whenever it is ready for one."""

    def __init__(self, host: str, port: int) -> None:
        """Begin to listen.

        Raises:
            ValueError: The port cannot be used.
        """
        check_port_is_free(host, port, "--websocket")
        self._news = threading.Condition()
        self._message, self._count, self._closed = "", 0, False
        self._server = serve(self._serve, host, port, compression=None)
        self._thread = threading.Thread(target=self._server.serve_forever, name="websocket", daemon=True)
        self._thread.start()

    def send(self, message: str) -> None:
        """Replace the message of the moment before."""
        with self._news:
            self._message, self._count = message, self._count + 1
            self._news.notify_all()

    def close(self) -> None:
        """Take leave of all clients."""
        with self._news:
            self._closed = True
            self._news.notify_all()
        self._server.shutdown()
        self._thread.join(_CLOSE_S)

    def _serve(self, client: ServerConnection) -> None:
        sent = self._count
        # Who has left is no longer served.
        with contextlib.suppress(ConnectionClosed):
            while True:
                with self._news:
                    self._news.wait_for(lambda: self._closed or self._count > sent)  # noqa: B023
                    if self._closed:
                        return
                    message, sent = self._message, self._count
                client.send(message)
