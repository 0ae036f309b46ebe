"""A stand-in for the Hugging Face Hub: the endpoints that huggingface_hub asks to upload and to download a dataset."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

WRITER, READER = "hf_writer", "hf_reader"
"""Tokens: one may write, the other only read."""


@dataclass
class Repo:
    """One dataset on the server."""

    private: bool = False
    files: dict[str, bytes] = field(default_factory=dict)
    large: set[str] = field(default_factory=set)
    """Paths of files that were uploaded apart from the commit."""
    commits: list[dict[str, bytes]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)

    @property
    def sha(self) -> str:
        return f"{len(self.commits):040x}"


@dataclass
class Hub:
    """What the server holds and was asked."""

    repos: dict[str, Repo] = field(default_factory=dict)
    blobs: dict[str, bytes] = field(default_factory=dict)
    """Uploaded contents by SHA-256."""
    asked: Counter[str] = field(default_factory=Counter)
    url: str = ""
    fail_after: int | None = None
    """Number of uploads and downloads after which the server drops connections."""


@contextmanager
def served() -> Iterator[Hub]:
    """A server at ``hub.url``."""
    hub = Hub()
    handler = type("Handler", (_Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        pass

    # --- answers --------------------------------------------------------------------------------------------------
    def answer(self, value: Any, status: int = 200, **headers: str) -> None:
        body = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(status)
        kind = "application/octet-stream" if isinstance(value, bytes) else "application/json"
        for name, text in {"Content-Type": kind, "Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def refuse(self, status: int, code: str = "") -> None:
        self.answer({"error": "refused"}, status, **({"X_Error_Code": code} if code else {}))

    def body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") == "chunked":
            chunks = []
            while size := int(self.rfile.readline(), 16):
                chunks.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(chunks)
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))

    def dropped(self) -> bool:
        """Whether the connection is dropped, as a bad net does."""
        if self.hub.fail_after is None:
            return False
        self.hub.fail_after -= 1
        if self.hub.fail_after < 0:
            self.close_connection = True
            self.refuse(403, "dropped")
        return self.hub.fail_after < 0

    @property
    def token(self) -> str:
        return (self.headers.get("Authorization") or "").removeprefix("Bearer ")

    def visible(self, name: str) -> Repo | None:
        repo = self.hub.repos.get(name)
        if repo is None or (repo.private and self.token not in (WRITER, READER)):
            self.refuse(404 if self.token else 401, "RepoNotFound")
            return None
        return repo

    def may_write(self) -> bool:
        if self.token != WRITER:
            self.refuse(403 if self.token == READER else 401)
        return self.token == WRITER

    # --- requests -------------------------------------------------------------------------------------------------
    def do_POST(self) -> None:
        path, body, hub = unquote(urlsplit(self.path).path), self.body(), self.hub
        if path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif not self.may_write():
            pass
        elif path == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked['organization']}/{asked['name']}"
            there = name in hub.repos
            hub.repos.setdefault(name, Repo(private=asked.get("visibility") == "private" or bool(asked.get("private"))))
            self.answer({"url": f"{hub.url}/datasets/{name}"}, 409 if there else 200)
        elif found := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)/preupload/[^/]+", path):
            modes = {
                f["path"]: "regular" if f["path"].endswith((".md", ".json")) else "lfs"
                for f in json.loads(body)["files"]
            }
            files = [{"path": name, "uploadMode": mode, "shouldIgnore": False} for name, mode in modes.items()]
            self.answer({"files": files})
        elif found := re.fullmatch(r"/datasets/([^/]+/[^/]+)\.git/info/lfs/objects/batch", path):
            objects: list[dict[str, Any]] = []
            for o in json.loads(body)["objects"]:
                upload = {"upload": {"href": f"{hub.url}/blobs/{o['oid']}"}}
                objects.append({**o} if o["oid"] in hub.blobs else {**o, "actions": upload})
            self.answer({"transfer": "basic", "objects": objects})
        elif found := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)/commit/[^/]+", path):
            self.commit(found[1], [json.loads(line) for line in body.splitlines()])
        elif found := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)/tag/[^/]+", path):
            repo = hub.repos[found[1]]
            repo.tags[json.loads(body)["tag"]] = repo.sha
            self.answer({})
        else:
            self.refuse(404)

    def commit(self, name: str, lines: list[dict[str, Any]]) -> None:
        repo = self.hub.repos[name]
        files = dict(repo.files)
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.hub.blobs[value["oid"]]
                repo.large.add(value["path"])
            elif line["key"] == "deletedFile":
                del files[value["path"]]
        repo.files = files
        repo.commits.append(files)
        self.answer({"commitUrl": f"{self.hub.url}/datasets/{name}/commit/{repo.sha}", "commitOid": repo.sha})

    def do_PUT(self) -> None:
        body, oid = self.body(), self.path.rpartition("/")[2]
        if self.dropped():
            return
        assert hashlib.sha256(body).hexdigest() == oid
        self.hub.blobs[oid] = body
        self.hub.asked["uploads"] += 1
        self.answer({})

    def do_DELETE(self) -> None:
        found = re.fullmatch(r"/api/datasets/([^/]+/[^/]+)/tag/(.+)", unquote(self.path))
        if found and self.may_write():
            there = self.hub.repos[found[1]].tags.pop(found[2], None)
            self.answer({}, 200 if there else 404)

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path, hub = unquote(urlsplit(self.path).path), self.hub
        if found := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)/refs", path):
            if repo := self.visible(found[1]):
                tags = [{"name": t, "ref": f"refs/tags/{t}", "targetCommit": sha} for t, sha in repo.tags.items()]
                self.answer({"branches": [], "converts": [], "tags": tags})
            return
        found = re.fullmatch(r"/(?:api/)?datasets/([^/]+/[^/]+)(?:/(revision|tree|resolve)/([^/]+)(?:/(.+))?)?", path)
        if not found:
            self.refuse(404)
            return
        repo = self.visible(found[1])
        if repo is None:
            return
        if found[3] and found[3] not in ("main", repo.sha, *repo.tags):
            self.refuse(404, "RevisionNotFound")
        elif found[2] == "tree":
            self.answer(
                [{"type": "file", "path": p, "size": len(d), "oid": _oid(d)} for p, d in sorted(repo.files.items())]
            )
        elif found[2] == "resolve":
            if self.command == "GET":
                if self.dropped():
                    return
                hub.asked["downloads"] += 1
            data = repo.files[found[4]]
            self.answer(data, X_Repo_Commit=repo.sha, ETag=f'"{_oid(data)}"')
        else:
            siblings = [{"rfilename": p} for p in repo.files]
            self.answer(
                {"_id": "1", "id": found[1], "sha": repo.sha, "siblings": siblings, "private": repo.private, "tags": []}
            )


def _oid(data: bytes) -> str:
    return hashlib.sha1(data).hexdigest()
