"""Server of one process that speaks what the client of the Hugging Face Hub needs, without a network."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

_API = re.compile(r"/api/models/([^/]+/[^/]+)(?:/(revision|tree|preupload|commit|branch)/(.+))?")
_FILE = re.compile(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)")


class FakeHub:
    """Repositories in memory: all files are stored as they are, none as Git LFS pointers."""

    def __init__(self) -> None:
        self.repositories: dict[str, dict[str, str]] = {}
        """Commit of each branch, by repository."""
        self.commits: dict[str, dict[str, bytes]] = {}
        """Files of each commit."""
        self.downloads: list[str] = []
        """Files that were downloaded."""
        self.private: set[str] = set()
        """Repositories that were created as private."""
        hub = self

        class Handler(_Handler):
            store = hub

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()

    def create(self, name: str, files: dict[str, bytes] | None = None) -> str:
        """Create a repository with one commit; return the commit."""
        self.repositories.setdefault(name, {})
        return self.commit(name, "main", files or {})

    def commit(self, name: str, branch: str, files: dict[str, bytes]) -> str:
        """Add a commit with exactly these files to a branch; return the commit."""
        commit = hashlib.sha1(f"{name} {branch} {len(self.commits)}".encode()).hexdigest()
        self.commits[commit] = files
        self.repositories[name][branch] = commit
        return commit

    def files(self, name: str, revision: str = "main") -> dict[str, bytes]:
        """Return the files of a revision."""
        return self.commits[self.repositories[name].get(revision, revision)]


class _Handler(BaseHTTPRequestHandler):
    store: FakeHub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        """Print nothing."""

    def do_HEAD(self) -> None:
        self._send_file(*_FILE.fullmatch(self._path()).groups(), body=False)

    def do_GET(self) -> None:
        if found := _FILE.fullmatch(self._path()):
            self._send_file(*found.groups(), body=True)
            return
        name, kind, revision = _API.fullmatch(self._path()).groups()
        commit = self._commit_of(name, revision or "main")
        if commit is None:
            return
        files = self.store.commits[commit]
        if kind == "tree":
            self._send([
                {"type": "file", "path": path, "size": len(data), "oid": _digest(data)}
                for path, data in files.items()
            ])  # fmt: skip
        else:
            siblings = [{"rfilename": path} for path in files]
            self._send({"id": name, "modelId": name, "sha": commit, "siblings": siblings})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        assert self.headers["Authorization"] == "Bearer token"
        if self._path() == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked['organization']}/{asked['name']}"
            is_new = name not in self.store.repositories
            if is_new:
                self.store.create(name)
                if asked.get("private") or asked.get("visibility") == "private":
                    self.store.private.add(name)
            self._send({"url": f"{self.store.url}/{name}"}, 200 if is_new else 409)
        elif self._path() == "/api/validate-yaml":
            self._send({"errors": [], "warnings": []})
        else:
            self._change(*_API.fullmatch(self._path()).groups(), body)

    def _change(self, name: str, kind: str, revision: str, body: bytes) -> None:
        branches = self.store.repositories[name]
        if kind == "branch":
            status = 409 if revision in branches else 200
            branches.setdefault(revision, branches["main"])
            self._send({}, status)
        elif kind == "preupload":
            modes = [
                {"path": file["path"], "uploadMode": "regular", "shouldIgnore": False}
                for file in json.loads(body)["files"]
            ]
            self._send({"files": modes})
        else:
            files = dict(self.store.files(name, revision))
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
                elif line["key"] == "deletedFile":
                    del files[line["value"]["path"]]
            commit = self.store.commit(name, revision, files)
            self._send(
                {"commitUrl": f"{self.store.url}/{name}/commit/{commit}", "commitOid": commit}
            )

    def _commit_of(self, name: str, revision: str) -> str | None:
        """Return a commit; sends the error of the Hub and returns None if there is none."""
        branches = self.store.repositories.get(name)
        if branches is None:
            self._send({"error": "Repository not found"}, 404, **{"X-Error-Code": "RepoNotFound"})
            return None
        commit = branches.get(revision, revision)
        if commit not in self.store.commits:
            self._send({"error": "Invalid rev id"}, 404, **{"X-Error-Code": "RevisionNotFound"})
            return None
        return commit

    def _send_file(self, name: str, revision: str, path: str, *, body: bool) -> None:
        if (commit := self._commit_of(name, revision)) is None:
            return
        data = self.store.commits[commit].get(path)
        if data is None:
            self._send({}, 404, **{"X-Error-Code": "EntryNotFound", "X-Repo-Commit": commit})
            return
        self.send_response(200)
        self.send_header("ETag", f'"{_digest(data)}"')
        self.send_header("X-Repo-Commit", commit)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if body:
            self.store.downloads.append(path)
            self.wfile.write(data)

    def _send(self, content: object, status: int = 200, **headers: str) -> None:
        data = json.dumps(content).encode()
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _path(self) -> str:
        return unquote(urlsplit(self.path).path)


def _digest(data: bytes) -> str:
    return hashlib.sha1(data).hexdigest()
