"""Chat endpoints with their addresses and options, and requests that are answered in time or fail clearly."""

from __future__ import annotations

import http.client
import os
import socket
import time
from collections.abc import Mapping
from contextlib import closing
from typing import Any, NamedTuple, Protocol
from urllib.parse import SplitResult, parse_qsl, urlsplit

import msgspec

from h3data.errors import H3DataError, InputError, suggest

KEY_VARIABLE = "H3DATA_LLM_KEY"
"""Environment variable with the key of the endpoint; it is never recorded."""
MOST_BYTES = 256 * 1024
"""Largest size of an answer [bytes]."""
CONNECT_S = 5.0
"""Time within which an endpoint accepts a connection when a job is checked [s]."""
MODES = ("tools", "text")
LOOPBACK = ("localhost", "127.0.0.1", "::1")
_EXAMPLE = "llm:http://127.0.0.1:8000/v1?model=NAME"


class LanguageModelError(H3DataError):
    """Error of a chat endpoint that does not answer in time, gives invalid answers, or has no budget left."""


class Address(NamedTuple):
    """Address of a chat endpoint with the options of an agent, such as ``llm:http://127.0.0.1:8000/v1?model=NAME``."""

    url: str
    """URL with scheme, host, port and path alone."""
    model: str
    mode: str = "tools"
    """Form of answers: ``tools``: tool calls; ``text``: a last line ``Action: NAME[ARGUMENTS]``."""
    plans: int = 50
    """Largest number of decisions in an episode; after that, the agent waits."""
    calls: int = 200
    """Largest number of requests in an episode; a further request ends the episode."""
    tokens: int = 1_000_000
    """Largest number of input and output tokens in an episode, as the endpoint counts them; exceeding it ends the
    episode.
    """
    timeout: int = 60
    """Longest time to wait for one answer [s]."""
    retries: int = 2
    """Number of further attempts if the endpoint cannot be reached, times out or is busy."""
    history: int = 10
    """Number of earlier decisions that a request includes."""
    budget: str = ""
    """File with the budget of the whole job (`h3data_llm.budget`); empty: no budget."""

    @classmethod
    def of(cls, text: str) -> Address:
        """Parse an address from text.

        Raises:
            InputError: the text is not an address, or contains a user, a password or a key, or an option is out of range.
        """
        parts = _split(text.removeprefix("llm:"))
        if "@" in parts.netloc:
            raise InputError(
                f"The address of a language model holds no user or password. Hint: put its key into {KEY_VARIABLE}.",
                code="H3-LLM-001",
            )
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        strange = sorted({*options} - {*cls._fields[1:]})
        if strange:
            name = strange[0][:40]
            known = [*cls._fields[1:]]
            raise InputError(
                f"Unknown option {name!r} of a language model.{suggest(name, known)} Keys belong into {KEY_VARIABLE}.",
                code="H3-LLM-002",
            )
        if not options.get("model"):
            raise InputError(f"Expected the name of a model, as {_EXAMPLE}.", code="H3-LLM-003")
        if options.get("mode", "tools") not in MODES:
            raise InputError(
                f"Expected the mode {' or '.join(MODES)}, got {options['mode'][:40]!r}.", code="H3-LLM-004"
            )
        texts = {name: options.pop(name) for name in ("model", "mode", "budget") if name in options}
        numbers: dict[str, Any] = {name: _number(name, value) for name, value in options.items()}
        return cls(f"{parts.scheme}://{parts.netloc.lower()}{parts.path.rstrip('/')}", **texts, **numbers)

    @property
    def parts(self) -> SplitResult:
        """Parts of the URL."""
        return urlsplit(self.url)


def _split(url: str) -> SplitResult:
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0 and not parts.fragment
    except ValueError:
        usable, parts = False, SplitResult("", "", "", "", "")
    if not usable or any(c.isspace() or ord(c) < 32 for c in url):
        raise InputError(f"Expected the address of a chat endpoint, as {_EXAMPLE}.", code="H3-LLM-005")
    return parts


def _number(name: str, value: str) -> int:
    least = 0 if name in ("retries", "history") else 1
    if not (value.isascii() and value.isdigit() and len(value) < 12 and int(value) >= least):
        raise InputError(f"Expected {name} of at least {least}, got {value[:40]!r}.", code="H3-LLM-006")
    return int(value)


class Reply(NamedTuple):
    """An answer of a chat endpoint."""

    message: Mapping[str, Any]
    """Members ``content`` and ``tool_calls`` of the first choice; empty if the answer has no choice."""
    model: str = ""
    """Name of the model as the endpoint states it."""
    tokens: tuple[int, int] = (0, 0)
    """Tokens of the request and of the answer, as the endpoint counts them."""


class Endpoint(Protocol):
    """Protocol of an endpoint that answers chat requests."""

    def ask(self, body: bytes) -> Reply:
        """Return the answer to the body of a request.

        Raises:
            LanguageModelError: the server gives no valid answer.
        """
        ...


class HttpEndpoint:
    """Chat endpoint over HTTP, with a connection of its own for each request."""

    def __init__(self, address: Address) -> None:
        """Create an endpoint and read its key from the environment.

        Args:
            address: Address of the endpoint.

        Raises:
            InputError: the key would go over a network in plain text.
        """
        self.address, self._key = address, os.environ.get(KEY_VARIABLE, "")
        if self._key and address.parts.scheme == "http" and address.parts.hostname not in LOOPBACK:
            raise InputError(
                f"{KEY_VARIABLE} would be sent to {address.url} in plain text. Hint: use https:// or a tunnel.",
                code="H3-LLM-007",
            )

    def check(self) -> None:
        """Check that a server listens at the address.

        Raises:
            LanguageModelError: no server listens there.
        """
        parts = self.address.parts
        port = parts.port or (443 if parts.scheme == "https" else 80)
        try:
            socket.create_connection((parts.hostname, port), timeout=CONNECT_S).close()
        except OSError as fault:
            raise self._absent(fault) from None

    def ask(self, body: bytes) -> Reply:
        """Return the answer to the body of a request, with further attempts if an attempt fails.

        Raises:
            LanguageModelError: the endpoint cannot be reached or times out, or its answer is not a chat completion.
        """
        for attempt in range(self.address.retries + 1):
            last = attempt == self.address.retries
            try:
                status, kind, data = self._post(body, time.monotonic() + self.address.timeout)
            except TimeoutError:
                if last:
                    raise LanguageModelError(
                        f"The language model at {self.address.url} did not answer within {self.address.timeout} s.",
                        code="H3-LLM-008",
                    ) from None
                continue
            except (OSError, http.client.HTTPException) as fault:
                if last:
                    raise self._absent(fault) from None
                time.sleep(0.5 * 2**attempt)
                continue
            if status == 200 or last or not (status == 429 or status >= 500):
                return self._read(status, kind, data)
            time.sleep(0.5 * 2**attempt)
        raise AssertionError("the last attempt returns or raises")

    def _post(self, body: bytes, deadline: float) -> tuple[int, str, bytes]:
        parts = self.address.parts
        connect = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        if self._key:
            headers["Authorization"] = f"Bearer {self._key}"
        with closing(connect(str(parts.hostname), parts.port, timeout=self.address.timeout)) as connection:
            connection.request("POST", f"{parts.path}/chat/completions", body, headers)
            sock = connection.sock
            sock.settimeout(max(deadline - time.monotonic(), 1e-3))
            with connection.getresponse() as response:
                data = b""
                while len(data) <= MOST_BYTES:
                    left = deadline - time.monotonic()
                    if left <= 0:
                        raise TimeoutError
                    sock.settimeout(left)
                    part = response.read1(1 << 16)
                    if not part:
                        break
                    data += part
                return response.status, response.headers.get_content_type(), data

    def _read(self, status: int, kind: str, data: bytes) -> Reply:
        url = self.address.url
        if len(data) > MOST_BYTES:
            raise LanguageModelError(
                f"The language model at {url} answers with more than {MOST_BYTES:,} bytes.", code="H3-LLM-009"
            )
        try:
            answer = msgspec.json.decode(data)
        except msgspec.DecodeError:
            raise LanguageModelError(
                f"Expected JSON from the language model at {url}, got {kind} with status {status}. Hint: the addresses of "
                "most endpoints end with /v1.",
                code="H3-LLM-010",
            ) from None
        if status != 200:
            raise LanguageModelError(
                f"The language model at {url} refuses with status {status}: {self._said(answer)}", code="H3-LLM-011"
            )
        return reply_of(answer, url)

    def _said(self, answer: Any) -> str:
        """Return the text of an endpoint about a fault, in one line and without the key."""
        found = answer.get("error", answer) if isinstance(answer, dict) else answer
        found = found.get("message", found) if isinstance(found, dict) else found
        text = " ".join(str(found).split())
        return (text.replace(self._key, "***") if self._key else text)[:200]

    def _absent(self, fault: Exception) -> LanguageModelError:
        why = (fault.strerror if isinstance(fault, OSError) else None) or type(fault).__name__
        return LanguageModelError(
            f"No language model answers at {self.address.url}: {why}. Hint: start it first.", code="H3-LLM-012"
        )


def reply_of(answer: Any, url: str) -> Reply:
    """Return the first choice of an answer in the format of OpenAI's chat completions.

    Raises:
        LanguageModelError: the answer has a different format.
    """
    choices = answer.get("choices") if isinstance(answer, dict) else None
    if not isinstance(choices, list):
        raise LanguageModelError(
            f"Expected an answer with choices from the language model at {url}, got another form. Hint: h3data speaks with "
            "/chat/completions of OpenAI's interface.",
            code="H3-LLM-013",
        )
    first = choices[0] if choices and isinstance(choices[0], dict) else {}
    message, usage = first.get("message"), answer.get("usage")
    counts = [usage.get(k) for k in ("prompt_tokens", "completion_tokens")] if isinstance(usage, dict) else [0, 0]
    used = [n if isinstance(n, int) and not isinstance(n, bool) and 0 <= n < 2**40 else 0 for n in counts]
    model = answer.get("model")
    return Reply(
        message if isinstance(message, dict) else {},
        model[:200] if isinstance(model, str) else "",
        (used[0], used[1]),
    )
