"""Messages between the front process and a worker over a socket: ``(kind, key, body)`` as length-prefixed msgpack.

Pickle is not used, because a compromised worker must not be able to run code in the front process.
"""

from __future__ import annotations

import asyncio
import select
import socket
from typing import Any

import msgspec

Letter = tuple[str, str, Any]
"""Message between processes: its kind, its game or seat, and its content of plain types."""
_LENGTH = 4
_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Letter] = msgspec.msgpack.Decoder(Letter)


def encode(kind: str, key: str, body: Any) -> bytes:
    """Return a message between processes as bytes, preceded by its length."""
    data = _encoder.encode((kind, key, body))
    return len(data).to_bytes(_LENGTH, "little") + data


async def receive(reader: asyncio.StreamReader) -> Letter:
    """Return the next message from the other process.

    Raises:
        asyncio.IncompleteReadError: the other process has closed the connection.
    """
    size = int.from_bytes(await reader.readexactly(_LENGTH), "little")
    return _decoder.decode(await reader.readexactly(size))


class Closed(Exception):
    """Error that is raised when the other process has closed the channel."""


class Channel:
    """Worker's end of the channel to the front process, with a time limit for waiting."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket, self._buffer = sock, bytearray()
        sock.setblocking(True)

    def send(self, kind: str, key: str, body: Any) -> None:
        """Send a message to the front process, and wait if it is slow.

        Raises:
            Closed: the front process has closed the channel.
        """
        try:
            self._socket.sendall(encode(kind, key, body))
        except OSError:
            raise Closed from None

    def receive(self, wait_s: float) -> list[Letter]:
        """Return the messages that have arrived, after waiting for at most ``wait_s`` [s].

        Raises:
            Closed: the front process has closed the channel.
        """
        ready = select.select([self._socket], [], [], max(wait_s, 0.0))[0]
        while ready:
            try:
                data = self._socket.recv(1 << 16)
            except OSError:
                raise Closed from None
            if not data:
                raise Closed
            self._buffer += data
            ready = select.select([self._socket], [], [], 0.0)[0]
        return self._taken()

    def _taken(self) -> list[Letter]:
        letters, at = [], 0
        while len(self._buffer) - at >= _LENGTH:
            end = at + _LENGTH + int.from_bytes(self._buffer[at : at + _LENGTH], "little")
            if end > len(self._buffer):
                break
            letters.append(_decoder.decode(memoryview(self._buffer)[at + _LENGTH : end]))
            at = end
        del self._buffer[:at]
        return letters
