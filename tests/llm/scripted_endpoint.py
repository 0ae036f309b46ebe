"""Chat endpoint for tests: a function answers each request, or the server misbehaves."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

Answer = dict[str, Any] | bytes | tuple[int, str, bytes]


class Served(NamedTuple):
    """A running server, and the requests that it has got."""

    url: str
    requests: list[dict[str, Any]]
    headers: list[dict[str, str]]

    def policy(self, **options: object) -> str:
        """Name of the policy of this server."""
        more = "".join(f"&{name}={value}" for name, value in options.items())
        return f"llm:{self.url}/v1?model=scripted{more}"


@contextmanager
def chat_server(answer: Callable[[dict[str, Any]], Answer]) -> Iterator[Served]:
    """A server on loopback that answers a request with a message, with bytes, or with (status, type, bytes)."""
    requests: list[dict[str, Any]] = []
    headers: list[dict[str, str]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            requests.append({**body, "path": self.path})
            headers.append(dict(self.headers))
            found = answer(body)
            if isinstance(found, dict):
                choices = [{"index": 0, "message": found, "finish_reason": "stop"}] if found else []
                usage = {"prompt_tokens": len(json.dumps(body)) // 4, "completion_tokens": 20}
                found = json.dumps({"model": "scripted-1", "choices": choices, "usage": usage}).encode()
            status, kind, data = (200, "application/json", found) if isinstance(found, bytes) else found
            try:
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)
            except OSError:  # the other side has given up
                pass

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield Served(f"http://127.0.0.1:{server.server_address[1]}", requests, headers)
        server.shutdown()
        thread.join()


def call(tool: str, **arguments: object) -> dict[str, Any]:
    """A message with one tool call."""
    function = {"name": tool, "arguments": json.dumps(arguments)}
    return {"role": "assistant", "content": None, "tool_calls": [{"id": "c", "type": "function", "function": function}]}


def text(content: str) -> dict[str, Any]:
    """A message with text alone."""
    return {"role": "assistant", "content": content}


def script(answers: Sequence[dict[str, Any]]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Gives the answers one after the other, and then says that it is done."""
    left = list(answers)
    return lambda body: left.pop(0) if left else call("done") if "tools" in body else text("Action: done[]")
