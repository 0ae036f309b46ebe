"""Start of a live-play server as a separate process, with its command-line options and its messages to the user."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro

from h3data.errors import H3DataError, InputError
from h3data.progress import say

PortOption = Annotated[int, tyro.conf.arg(help="Port of the page (default: any free one).")]
HostOption = Annotated[
    str,
    tyro.conf.arg(
        help="Address to listen on. Others than this machine's own need TLS (--cert and --key) or --behind-proxy."
    ),
]
CertOption = Annotated[Path | None, tyro.conf.arg(help="File of the TLS certificate.")]
KeyOption = Annotated[Path | None, tyro.conf.arg(help="File of its key.")]
ProxyFlag = Annotated[bool, tyro.conf.arg(help="A proxy in front of this server does TLS.")]
AllowHostOption = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="NAME",
        help="Further names by which browsers reach the server, such as study.example.org behind a proxy. "
        "Known without it: loopback, addresses, --host and the certificate's names.",
    ),
]
NoBrowserFlag = Annotated[bool, tyro.conf.arg(help="Only print the address.")]


def serving_options(
    what: str,
    *,
    host: str,
    port: int,
    cert: Path | None,
    key: Path | None,
    behind_proxy: bool,
    allow_hosts: Sequence[str] = (),
) -> dict[str, Any]:
    """Check and return the options of the server process.

    Raises:
        InputError: an option is invalid, or aiohttp is missing.
    """
    require_aiohttp(what)
    if not 0 <= port < 65536:
        raise InputError(f"Expected a --port from 0 to 65535, got {port}.", code="H3-PLAY-006")
    if (cert is None) != (key is None):
        raise InputError("Give both --cert and --key, or neither.", code="H3-PLAY-007")
    for file in (cert, key):
        if file is not None and not file.is_file():
            raise InputError(f"There is no such file: {file}", code="H3-PLAY-011")
    for name in allow_hosts:
        if re.fullmatch(r"(\*\.)?[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*\.?", name) is None:
            raise InputError(
                f"Expected --allow-host with a name such as study.example.org, without port, got {name}",
                code="H3-PLAY-012",
            )
    return {
        "host": host,
        "port": port,
        "cert": str(cert or ""),
        "key": str(key or ""),
        "behind_proxy": behind_proxy,
        "allow_hosts": list(allow_hosts),
    }


def require_aiohttp(what: str) -> None:
    """Check that the package aiohttp is installed.

    Raises:
        InputError: aiohttp is not installed.
    """
    if importlib.util.find_spec("aiohttp") is None:
        raise InputError(f"{what} needs the package aiohttp. Hint: pip install 'h3data[hitl]'", code="H3-PLAY-008")


def run_server(module: str, options: dict[str, Any], heard: Callable[[dict[str, Any]], None]) -> None:
    """Run a server, the process ``python -m module``, until it ends; ``heard`` is called with its reports.

    Raises:
        H3DataError: the server ended with an error.
        KeyboardInterrupt: after Ctrl-C, once the server has ended.
    """
    process = _start(module, options)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        for line in process.stdout:
            heard(msgspec.json.decode(line))
    except KeyboardInterrupt:
        process.terminate()  # where only this process was told
        for line in process.stdout:
            heard(msgspec.json.decode(line))
        process.wait()
        raise
    finally:
        process.stdin.close()
        process.wait()
    if process.returncode:
        raise H3DataError(
            f"The server ended with exit code {process.returncode}; its message is above.", code="H3-PLAY-009"
        )


@contextmanager
def started_server(module: str, options: dict[str, Any]) -> Iterator[tuple[list[list[str]], Iterator[dict[str, Any]]]]:
    """Start a server for a ``with`` block; yield the links of its seats and an iterator of its reports.

    Raises:
        InputError: the server refuses its options.
        H3DataError: the server ended before it listened.
    """
    process = _start(module, options)
    assert process.stdin is not None
    reports = _reports(process)
    try:
        for report in reports:
            if "refused" in report:
                raise InputError(report["refused"], code=report.get("code", ""))
            if "ready" in report:
                yield report["ready"]["links"], reports
                return
        raise H3DataError("The server ended while it started; its message is above.", code="H3-PLAY-010")
    finally:
        process.terminate()
        process.stdin.close()
        process.wait()


def _reports(process: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            yield msgspec.json.decode(line)


def _start(module: str, options: dict[str, Any]) -> subprocess.Popen[bytes]:
    paths = os.pathsep.join(path for path in sys.path if path)
    process = subprocess.Popen(
        [sys.executable, "-m", module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": paths},
    )
    assert process.stdin is not None
    process.stdin.write(msgspec.json.encode(options) + b"\n")
    process.stdin.flush()
    return process


def say_disk(disk: dict[str, Any], folder: Path) -> None:
    """Print that the disk of a session's folder is full, or that there is space again."""
    if disk["is_full"]:
        say(
            f"Nothing more can be written to {folder} ({disk['why']}). Who plays is told to wait, and nothing that was "
            "recorded is lost. Make space: it goes on by itself."
        )
    else:
        say("There is space on the disk again; the episodes go on.")
