"""Connections to policy servers, which return an answer in time or an error with the reason.

Neither kind of connection has threads, so waiting uses no CPU and the process may be forked.
"""

from __future__ import annotations

import os
import select
import socket
import ssl
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol
from urllib.parse import parse_qsl, urlsplit

from h3data.errors import InputError, MissingExtraError
from h3data_remote.wire import GROOT, MISSING, MOST_BYTES, OPENPI, Codec, PolicyServerError

try:
    import zmq
    from websockets.client import ClientProtocol
    from websockets.exceptions import WebSocketException
    from websockets.frames import Frame, Opcode
    from websockets.http11 import Response
    from websockets.protocol import State
    from websockets.uri import parse_uri
except ImportError as error:
    raise MissingExtraError(MISSING, code="H3-REMOTE-014") from error

CONNECT_S = 10.0
"""Time within which a server accepts a connection and introduces itself [s]."""
KEY_VARIABLE = "H3DATA_POLICY_KEY"
"""Name of the environment variable with the key for policy servers; the key is never recorded."""
DEFAULT_PORTS = {"ws": 8000, "wss": 443, "zmq": 5555}
LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True)
class Address:
    """Address of a policy server, such as ``ws://127.0.0.1:8000?adapter=spot.toml``."""

    scheme: str
    host: str
    port: int
    path: str = ""
    adapter: str = ""
    """Name or file of the adapter; empty selects the server's adapter, or the default of its protocol."""

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}{self.path}"

    @property
    def is_loopback(self) -> bool:
        """Return whether the server is on this machine."""
        return self.host in LOOPBACK

    @classmethod
    def of(cls, text: str) -> Address:
        """Parse the address of a policy server.

        Raises:
            InputError: the text is not an address, or contains a user or a password.
        """
        try:
            parts = urlsplit(text)
            port = parts.port
            (parts.hostname or "").encode("idna")  # as the look-up of a name does
        except ValueError:
            raise InputError(
                "Expected an address such as ws://127.0.0.1:8000: its port is no number, or its host no name.",
                code="H3-REMOTE-027",
            ) from None
        if "@" in parts.netloc:
            raise InputError(
                f"An address holds no user or password, since it is recorded. Hint: put the server's key into {KEY_VARIABLE}.",
                code="H3-REMOTE-019",
            )
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        if parts.scheme not in DEFAULT_PORTS or not parts.hostname or {*options} - {"adapter"} or parts.fragment:
            raise InputError(
                "Expected the address of a policy server, as ws://HOST:PORT, wss://HOST:PORT or zmq://HOST:PORT, with "
                f"?adapter=NAME or FILE at its end if need be. Its scheme is {parts.scheme or 'missing'}, its options are: "
                f"{', '.join(options) or 'none'}.",
                code="H3-REMOTE-020",
            )
        port = port or DEFAULT_PORTS[parts.scheme]
        return cls(parts.scheme, parts.hostname, port, parts.path.rstrip("/"), options.get("adapter", ""))


class Connection(Protocol):
    """Connection to a policy server for one episode."""

    metadata: dict[str, Any]
    """Metadata that the server states about itself."""

    def ask(self, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send a request to the server and return its answer.

        Raises:
            PolicyServerError: the server does not answer in time, or answers with an error; the connection is closed.
        """
        ...

    def close(self) -> None:
        """End the conversation; a second call does nothing."""


def connect(address: Address) -> Connection:
    """Open a new connection.

    Raises:
        PolicyServerError: there is no answer, or it is not that of a policy server.
        InputError: a key would go over a network in plain text.
    """
    key = os.environ.get(KEY_VARIABLE, "")
    if key and address.scheme == "ws" and not address.is_loopback:
        raise InputError(
            f"{KEY_VARIABLE} would be sent to {address} in plain text. Hint: use wss://, or a tunnel to this machine.",
            code="H3-REMOTE-015",
        )
    return ZmqConnection(address, key) if address.scheme == "zmq" else WebSocketConnection(address, key)


class WebSocketConnection:
    """Connection with openpi's protocol: the server sends its metadata first, then one answer per request."""

    def __init__(self, address: Address, key: str = "") -> None:
        """Connect to a server and read its metadata.

        Args:
            address: Address of the server.
            key: Value of the header ``Authorization: Api-Key``; empty for no key.

        Raises:
            PolicyServerError: there is no answer, or it is not that of a policy server.
        """
        self._address = address
        deadline = time.monotonic() + CONNECT_S
        try:
            self._socket = socket.create_connection((address.host, address.port), timeout=CONNECT_S)
        except OSError as fault:
            raise PolicyServerError(
                f"No policy server answers at {address}: {fault.strerror or fault}. Hint: start it first.",
                code="H3-REMOTE-028",
            ) from None
        self._is_open, self._response = True, None
        self._messages: list[tuple[Opcode, bytes]] = []
        self._parts: list[Frame] = []
        try:
            # Nagle's algorithm would hold small requests back until the packet before is acknowledged
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if address.scheme == "wss":
                self._socket = ssl.create_default_context().wrap_socket(self._socket, server_hostname=address.host)
            # the protocol without its client, which reads in a second thread and costs three times the CPU of a small request
            self._protocol = ClientProtocol(parse_uri(str(address)), max_size=MOST_BYTES)
            request = self._protocol.connect()
            if key:
                request.headers["Authorization"] = f"Api-Key {key}"
            self._protocol.send_request(request)
            self._send(deadline)
            while self._response is None:
                self._receive(deadline, CONNECT_S)
            self.metadata = self._message(deadline, CONNECT_S)
        except (OSError, ssl.SSLError) as fault:
            self.close()
            raise PolicyServerError(
                f"The policy server at {address} breaks off: {fault}", code="H3-REMOTE-029"
            ) from None
        except BaseException:
            self.close()
            raise

    def ask(self, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """Return the server's answer to a request.

        Raises:
            PolicyServerError: the server does not answer in time, or answers with an error; the connection is closed.
        """
        packed, deadline = OPENPI.pack(request), time.monotonic() + timeout_s
        try:
            if not self._is_open:
                raise PolicyServerError(
                    f"The connection to the policy server at {self._address} is closed.", code="H3-REMOTE-030"
                )
            self._refuse_more(deadline, timeout_s)
            self._protocol.send_binary(packed)
            self._send(deadline)
            return self._message(deadline, timeout_s)
        except OSError as fault:
            self.close()
            raise self._late(timeout_s) if isinstance(fault, TimeoutError) else self._gone(str(fault)) from None
        except WebSocketException as fault:
            self.close()
            raise self._gone(str(fault)) from None
        except BaseException:  # a late answer must not be taken for that to the next request
            self.close()
            raise

    def close(self) -> None:
        """End the conversation; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            with suppress(OSError, WebSocketException, AttributeError):
                self._protocol.send_close(1000)
                self._send(time.monotonic() + 0.5)
            self._socket.close()

    # --- inside -------------------------------------------------------------------------------------------------------
    def _refuse_more(self, deadline: float, timeout_s: float) -> None:
        """Refuse a server that has sent more than it was asked for: each later answer would be taken for the next request's.

        Raises:
            PolicyServerError: it has.
        """
        if not self._messages and select.select([self._socket], [], [], 0)[0]:
            self._receive(deadline, timeout_s)
        if self._messages or self._parts:
            raise PolicyServerError(
                f"The policy server at {self._address} sends messages that nobody asked for.", code="H3-REMOTE-062"
            )

    def _message(self, deadline: float, timeout_s: float) -> dict[str, Any]:
        while not self._messages:
            self._receive(deadline, timeout_s)
        opcode, data = self._messages.pop(0)
        # openpi's servers answer a fault with its traceback as text, whose last line is the message
        if opcode is Opcode.TEXT:
            lines = data.decode("utf-8", "replace").strip().splitlines()
            said = lines[-1][:300] if lines else "nothing"
            raise PolicyServerError(
                f"The policy server at {self._address} reports a fault: {said}", code="H3-REMOTE-021"
            )
        found = _read(OPENPI, data, self._address)
        if not isinstance(found, dict):
            raise PolicyServerError(
                f"Expected a map from the policy server at {self._address}, got {type(found).__name__}.",
                code="H3-REMOTE-022",
            )
        return found

    def _receive(self, deadline: float, timeout_s: float) -> None:
        left = deadline - time.monotonic()
        if left <= 0:
            raise self._late(timeout_s)
        self._socket.settimeout(left)
        try:
            data = self._socket.recv(1 << 18)
        except TimeoutError:
            raise self._late(timeout_s) from None
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        self._send(deadline)  # an answer to a ping, for example
        for event in self._protocol.events_received():
            if isinstance(event, Response):
                self._response = event
            elif isinstance(event, Frame):
                self._take(event)
        if self._protocol.handshake_exc is not None:
            raise PolicyServerError(
                f"Something answers at {self._address}, but not as a policy server: {self._protocol.handshake_exc}",
                code="H3-REMOTE-023",
            )
        if self._messages:
            return
        if self._protocol.parser_exc is not None:
            raise PolicyServerError(
                f"The policy server at {self._address} sends what is no message, or one of more than {MOST_BYTES:,} bytes: "
                f"{self._protocol.parser_exc}",
                code="H3-REMOTE-024",
            )
        if not data or self._protocol.state in (State.CLOSING, State.CLOSED):
            closed = self._protocol.close_rcvd
            raise self._gone("" if closed is None else f"code {int(closed.code)} {closed.reason}".strip())

    def _take(self, frame: Frame) -> None:
        """Put frames of one message together."""
        if frame.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
            self._parts.append(frame)
            if frame.fin:
                self._messages.append((self._parts[0].opcode, b"".join(bytes(part.data) for part in self._parts)))
                self._parts = []

    def _send(self, deadline: float) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
                self._socket.sendall(data)

    def _late(self, timeout_s: float) -> PolicyServerError:
        return PolicyServerError(
            f"The policy server at {self._address} did not answer within {timeout_s:g} s.", code="H3-REMOTE-016"
        )

    def _gone(self, why: str) -> PolicyServerError:
        return PolicyServerError(
            f"The policy server at {self._address} closed the connection{f' ({why})' if why else ''}.",
            code="H3-REMOTE-017",
        )


def _read(codec: Codec, packed: bytes, address: Address) -> Any:
    """Return the message in what a server has sent."""
    try:
        return codec.unpack(packed)
    except PolicyServerError as fault:
        raise PolicyServerError(
            f"The policy server at {address} sends what cannot be read. {fault}", code="H3-REMOTE-025"
        ) from None


class ZmqConnection:
    """Connection with GR00T's protocol: requests to named endpoints over ZeroMQ, each with one answer."""

    def __init__(self, address: Address, key: str = "") -> None:
        """Connect to a server and request its configuration.

        Args:
            address: Address of the server.
            key: ``api_token`` of each request; empty for no key.

        Raises:
            PolicyServerError: there is no answer, or it is not that of a policy server.
        """
        self._address, self._key = address, key
        self._context = zmq.Context()
        self._socket: zmq.Socket[bytes] = self._context.socket(zmq.REQ)
        # without LINGER 0, ending the context waits for ever for requests that a dead server never took
        for option, value in ((zmq.LINGER, 0), (zmq.MAXMSGSIZE, MOST_BYTES), (zmq.IPV6, int(":" in address.host))):
            self._socket.setsockopt(option, value)
        # ZeroMQ connects again by itself and then waits for an answer that never comes; this socket tells of the break
        self._breaks = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        try:
            self._socket.connect(str(address).replace("zmq://", "tcp://", 1))
            self._call("ping", None, CONNECT_S)
            found = self._call("get_modality_config", None, CONNECT_S)
            self.metadata: dict[str, Any] = found if isinstance(found, dict) else {}
            self._call("reset", {"options": None}, CONNECT_S)
        except zmq.ZMQError as fault:  # no address of a server, such as *
            self.close()
            raise PolicyServerError(
                f"No policy server answers at {address}: {fault.strerror}. Hint: start it first.", code="H3-REMOTE-063"
            ) from None
        except BaseException:
            self.close()
            raise

    def ask(self, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """Return the server's answer to an observation.

        Raises:
            PolicyServerError: the server does not answer in time, or answers with an error; the connection is closed.
        """
        try:
            answer = self._call("get_action", {"observation": request, "options": None}, timeout_s)
        except BaseException:  # a late answer must not be taken for that to the next request
            self.close()
            raise
        if isinstance(answer, list) and answer and isinstance(answer[0], dict):
            return answer[0]
        self.close()
        raise PolicyServerError(
            f"Expected [actions, info] from the policy server at {self._address}, got {type(answer).__name__}.",
            code="H3-REMOTE-018",
        )

    def close(self) -> None:
        """End the conversation; a second call does nothing."""
        if not self._socket.closed:
            self._socket.disable_monitor()
            self._breaks.close(linger=0)
        self._socket.close(linger=0)
        self._context.term()

    def _call(self, endpoint: str, data: dict[str, Any] | None, timeout_s: float) -> Any:
        request: dict[str, Any] = {"endpoint": endpoint}
        if data is not None:
            request["data"] = data
        if self._key:
            request["api_token"] = self._key
        # 0 would mean "at once" and -1 "for ever"
        milliseconds = max(int(timeout_s * 1000), 1)
        try:
            self._socket.setsockopt(zmq.SNDTIMEO, milliseconds)
            self._socket.send(GROOT.pack(request))
            poller = zmq.Poller()
            poller.register(self._socket, zmq.POLLIN)
            poller.register(self._breaks, zmq.POLLIN)
            if self._breaks in dict(poller.poll(milliseconds)):
                raise PolicyServerError(
                    f"The policy server at {self._address} closed the connection, or sent more than {MOST_BYTES:,} bytes.",
                    code="H3-REMOTE-061",
                )
            answer = _read(GROOT, self._socket.recv(zmq.NOBLOCK), self._address)
        except zmq.Again:
            raise PolicyServerError(
                f"The policy server at {self._address} did not answer {endpoint!r} within {timeout_s:g} s.",
                code="H3-REMOTE-031",
            ) from None
        except zmq.ZMQError as fault:
            raise PolicyServerError(
                f"The connection to the policy server at {self._address} is closed: {fault}", code="H3-REMOTE-032"
            ) from None
        if isinstance(answer, dict) and "error" in answer:
            said = str(answer["error"]).strip().splitlines() or ["nothing"]
            raise PolicyServerError(
                f"The policy server at {self._address} reports a fault: {said[-1][:300]}", code="H3-REMOTE-026"
            )
        return answer
