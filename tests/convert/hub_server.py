"""A small Hugging Face hub on loopback: enough of its HTTP interface for the real client to push and load datasets,
and to rewrite the cards of models.

It keeps repositories in memory as git does (commits that map paths to blobs), large files by SHA-256, and checks what
it receives: sizes and hashes of LFS objects, that a commit names only objects that were uploaded, that a card's header
is valid. Not spoken: Xet (the client falls back to LFS with HF_HUB_DISABLE_XET=1).
"""

import base64
import hashlib
import json
import re
import threading
import time
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlparse

import yaml

TOKEN = "hf_loopback"
LARGE = re.compile(r"\.(parquet|mp4|npy|safetensors|arrow)$")
"""Files that the hub stores in LFS whatever their size."""


_LAUNCH = """
import os, sys
import httpx
import huggingface_hub

class Loopback(httpx.HTTPTransport):
    def handle_request(self, request):
        here = httpx.URL(os.environ["HF_ENDPOINT"])
        request.url = request.url.copy_with(scheme=here.scheme, host=here.host, port=here.port)
        request.headers["Host"] = here.netloc.decode()
        request.headers["Authorization"] = "Bearer " + os.environ["HF_TOKEN"]
        return super().handle_request(request)

huggingface_hub.set_client_factory(
    lambda: httpx.Client(mounts={"https://huggingface.co": Loopback()}, follow_redirects=True, timeout=60)
)
from MODULE import main
sys.exit(main())
"""


def launcher(module: str) -> str:
    """Python that runs a command's `main` with all of the hub's addresses led to the loopback.

    The client has one of them in its code: huggingface_hub 1.x has cards checked at https://huggingface.co whatever
    HF_ENDPOINT says.
    """
    return _LAUNCH.replace("MODULE", module)


@dataclass
class Repository:
    """Commits (newest last) with their files: path -> (blob's SHA-1, size, LFS SHA-256 or None)."""

    private: bool
    commits: list[tuple[str, dict[str, tuple[str, int, str | None]]]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, revision: str) -> tuple[str, dict[str, tuple[str, int, str | None]]] | None:
        """The commit that a branch, a tag or a hash names."""
        if revision == "main":
            return self.commits[-1]
        wanted = self.tags.get(revision, revision)
        return next((commit for commit in self.commits if commit[0] == wanted), None)


class Hub:
    """The server; a context manager.

    Attributes:
        url: For HF_ENDPOINT.
        repositories: "user/name" -> repository.
        uploads: SHA-256 of every large object that was sent, in order.
        fail_after: Refuse large objects after so many; None: never.
        delay: Seconds that receiving a large object takes.
    """

    def __init__(self) -> None:
        self.repositories: dict[str, Repository] = {}
        self.large: dict[str, bytes] = {}
        self.blobs: dict[str, bytes] = {}
        self.uploads: list[str] = []
        self.fail_after: int | None = None
        self.delay = 0.0
        self.lock = threading.Lock()
        handler = type("Handler", (_Handler,), {"hub": self})
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"

    def __enter__(self) -> "Hub":
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        self.server.server_close()

    def files(self, repo_id: str) -> dict[str, bytes]:
        """The newest commit's files."""
        return {path: self.content(entry) for path, entry in self.repositories[repo_id].commits[-1][1].items()}

    def content(self, entry: tuple[str, int, str | None]) -> bytes:
        """A file's bytes."""
        blob, _, large = entry
        return self.large[large] if large else self.blobs[blob]


class _Refused(Exception):
    def __init__(self, status: int, message: str, code: str | None = None):
        super().__init__(message)
        self.status, self.code = status, code


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    ROUTES = (
        ("POST", r"/api/repos/create", "create"),
        ("GET", r"/api/whoami-v2", "whoami"),
        ("POST", r"/api/validate-yaml", "validate_yaml"),
        ("POST", r"/api/(?:datasets|models)/([^/]+/[^/]+)/preupload/([^/]+)", "preupload"),
        ("POST", r"/datasets/([^/]+/[^/]+)\.git/info/lfs/objects/batch", "lfs_batch"),
        ("PUT", r"/lfs/([0-9a-f]{64})", "lfs_put"),
        ("POST", r"/lfs/([0-9a-f]{64})/verify", "lfs_verify"),
        ("POST", r"/api/(?:datasets|models)/([^/]+/[^/]+)/commit/([^/]+)", "commit"),
        ("POST", r"/api/datasets/([^/]+/[^/]+)/tag/([^/]+)", "tag"),
        ("DELETE", r"/api/datasets/([^/]+/[^/]+)/tag/([^/]+)", "untag"),
        ("GET", r"/api/datasets/([^/]+/[^/]+)/refs", "refs"),
        ("GET", r"/api/datasets/([^/]+/[^/]+)/tree/([^/]+)", "tree"),
        ("GET", r"/api/datasets/([^/]+/[^/]+)(?:/revision/([^/]+))?", "info"),
        ("(?:GET|HEAD)", r"(?:/datasets)?/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", "resolve"),
    )

    def _serve(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = urlparse(self.path).path
        try:
            for method, pattern, name in self.ROUTES:
                found = re.fullmatch(pattern, path)
                if found and re.fullmatch(method, self.command):
                    if not name.startswith("lfs_p") and self.headers.get("Authorization") != f"Bearer {TOKEN}":
                        raise _Refused(401, "no token")
                    parts = [unquote(part) if part else part for part in found.groups()]
                    with self.hub.lock:
                        return getattr(self, name)(body, *parts)
            raise _Refused(404, f"the test hub does not know {self.command} {path}")
        except _Refused as error:
            self._answer({"error": str(error)}, error.status, {"X-Error-Code": error.code} if error.code else {})

    do_GET = do_POST = do_PUT = do_DELETE = do_HEAD = _serve

    def log_message(self, *_: object) -> None:
        pass

    def _answer(self, content: Any, status: int = 200, headers: dict[str, str] | None = None) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _repo(self, repo_id: str) -> Repository:
        if repo_id not in self.hub.repositories:
            raise _Refused(404, f"no dataset {repo_id}", "RepoNotFound")
        return self.hub.repositories[repo_id]

    def _at(self, repo_id: str, revision: str | None) -> tuple[str, dict[str, tuple[str, int, str | None]]]:
        found = self._repo(repo_id).commit(revision or "main")
        if found is None:
            raise _Refused(404, f"no revision {revision}", "RevisionNotFound")
        return found

    def create(self, body: bytes) -> None:
        asked = json.loads(body)
        if asked["type"] != "dataset":
            raise _Refused(400, "only datasets here")
        repo_id = f"{asked.get('organization') or 'me'}/{asked['name']}"
        url = {"url": f"{self.hub.url}/datasets/{repo_id}"}
        if repo_id in self.hub.repositories:
            return self._answer({**url, "error": "exists"}, 409)
        private = asked.get("visibility") == "private" or bool(asked.get("private"))  # newer, older clients
        repository = Repository(private=private)
        repository.commits.append((hashlib.sha1(repo_id.encode()).hexdigest(), {}))
        self.hub.repositories[repo_id] = repository
        self._answer(url)

    def whoami(self, body: bytes) -> None:
        self._answer({"type": "user", "name": "me", "orgs": [], "auth": {"accessToken": {"role": "write"}}})

    def validate_yaml(self, body: bytes) -> None:
        content = json.loads(body)["content"]
        header = yaml.safe_load(content.split("---")[1])
        unknown = header.get("license") not in (None, "mit", "apache-2.0", "cc-by-4.0", "other")
        errors = [{"message": '"license" must be one of the hub\'s'}] if unknown else []
        self._answer({"errors": errors, "warnings": []}, 400 if errors else 200)

    def preupload(self, body: bytes, repo_id: str, revision: str) -> None:
        _, files = self._at(repo_id, revision)
        modes = [
            {
                "path": file["path"],
                "uploadMode": "lfs" if LARGE.search(file["path"]) or file["size"] > 10_000_000 else "regular",
                "shouldIgnore": False,
                "oid": files[file["path"]][0] if file["path"] in files else None,
            }
            for file in json.loads(body)["files"]
        ]
        self._answer({"files": modes})

    def lfs_batch(self, body: bytes, repo_id: str) -> None:
        self._repo(repo_id)
        objects = []
        for item in json.loads(body)["objects"]:
            href = f"{self.hub.url}/lfs/{item['oid']}"
            actions = {"upload": {"href": href}, "verify": {"href": f"{href}/verify"}}
            objects.append(item if item["oid"] in self.hub.large else {**item, "actions": actions})
        self._answer({"transfer": "basic", "objects": objects})

    def lfs_put(self, body: bytes, sha: str) -> None:
        if self.hub.fail_after is not None and len(self.hub.uploads) >= self.hub.fail_after:
            raise _Refused(403, "the line was cut")
        if hashlib.sha256(body).hexdigest() != sha:
            raise _Refused(400, "SHA-256 does not match")
        time.sleep(self.hub.delay)
        self.hub.uploads.append(sha)
        self.hub.large[sha] = body
        self._answer(b"")

    def lfs_verify(self, body: bytes, sha: str) -> None:
        if len(self.hub.large.get(sha, b"")) != json.loads(body)["size"]:
            raise _Refused(422, "size does not match")
        self._answer({})

    def commit(self, body: bytes, repo_id: str, revision: str) -> None:
        if revision != "main":
            raise _Refused(404, f"no branch {revision}", "RevisionNotFound")
        repository = self._repo(repo_id)
        files = dict(repository.commits[-1][1])
        for line in body.splitlines():
            item = json.loads(line)
            value = item["value"]
            if item["key"] == "file":
                data = base64.b64decode(value["content"])
                blob = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
                self.hub.blobs[blob] = data
                files[value["path"]] = blob, len(data), None
            elif item["key"] == "lfsFile":
                sha = value["oid"]
                if sha not in self.hub.large:
                    raise _Refused(400, f"{value['path']}: object {sha} was not uploaded")
                files[value["path"]] = hashlib.sha1(sha.encode()).hexdigest(), len(self.hub.large[sha]), sha
            elif item["key"] != "header":
                raise _Refused(400, f"unknown operation {item['key']}")
        oid = hashlib.sha1(repository.commits[-1][0].encode() + body).hexdigest()
        repository.commits.append((oid, files))
        self._answer(
            {
                "commitOid": oid,
                "commitUrl": f"{self.hub.url}/datasets/{repo_id}/commit/{oid}",
                "success": True,
            }
        )

    def tag(self, body: bytes, repo_id: str, revision: str) -> None:
        name = json.loads(body)["tag"]
        repository = self._repo(repo_id)
        if name in repository.tags:
            raise _Refused(409, f"tag {name} exists")
        repository.tags[name] = self._at(repo_id, revision)[0]
        self._answer({})

    def untag(self, body: bytes, repo_id: str, name: str) -> None:
        if self._repo(repo_id).tags.pop(name, None) is None:
            raise _Refused(404, f"no tag {name}", "RevisionNotFound")
        self._answer({})

    def refs(self, body: bytes, repo_id: str) -> None:
        repository = self._repo(repo_id)
        branches = [{"name": "main", "ref": "refs/heads/main", "targetCommit": repository.commits[-1][0]}]
        tags = [{"name": n, "ref": f"refs/tags/{n}", "targetCommit": c} for n, c in repository.tags.items()]
        self._answer({"branches": branches, "converts": [], "tags": tags})

    def tree(self, body: bytes, repo_id: str, revision: str) -> None:
        entries = []
        for path, (blob, size, large) in sorted(self._at(repo_id, revision)[1].items()):
            entry: dict[str, Any] = {"type": "file", "path": path, "oid": blob, "size": size}
            if large:
                entry["lfs"] = {"oid": large, "size": size, "pointerSize": 130}
            entries.append(entry)
        self._answer(entries)

    def info(self, body: bytes, repo_id: str, revision: str | None) -> None:
        sha, files = self._at(repo_id, revision)
        siblings = [{"rfilename": path} for path in files]
        private = self._repo(repo_id).private
        self._answer({"id": repo_id, "sha": sha, "private": private, "tags": [], "siblings": siblings})

    def resolve(self, body: bytes, repo_id: str, revision: str, path: str) -> None:
        sha, files = self._at(repo_id, revision)
        if path not in files:
            raise _Refused(404, f"no file {path}", "EntryNotFound")
        entry = files[path]
        etag = {"ETag": f'"{entry[2] or entry[0]}"', "X-Repo-Commit": sha}
        self._answer(self.hub.content(entry), headers=etag)
