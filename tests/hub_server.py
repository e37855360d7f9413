"""A stand-in for Hugging Face on this machine: the routes that uploads and downloads of a model ask for."""

import base64
import hashlib
import json
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

TOKEN = "hf_right"


class Hub(BaseHTTPRequestHandler):
    """Keeps commits of one repository at a time in memory, in attributes of the server."""

    protocol_version = "HTTP/1.1"

    def log_message(self, *arguments):
        """Nothing is printed."""

    def answer(self, value, status=200, **headers):
        body = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(status)
        length = headers.pop("Content-Length", str(len(body)))
        for name, text in {"Content-Length": length, "Content-Type": "application/json", **headers}.items():
            self.send_header(name.replace("_", "-"), text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def refuse(self, code, status=404):
        self.answer({"error": code}, status, **{"X-Error-Code": code, "X-Error-Message": code})

    def read_body(self):
        if self.headers.get("Transfer-Encoding") == "chunked":
            body = b""
            while size := int(self.rfile.readline().strip() or b"0", 16):
                body += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return body
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))

    def do_POST(self):
        hub, body = self.server, self.read_body()
        hub.asked.append(f"POST {self.path}")
        if self.headers.get("Authorization") != f"Bearer {TOKEN}" and "validate-yaml" not in self.path:
            return self.refuse("Unauthorized", 401)
        if self.path == "/api/repos/create":
            return self.answer({"url": f"{hub.url}/me/traffic", "id": "me/traffic"}, 409 if hub.exists else 200)
        if self.path == "/api/validate-yaml":
            hub.card = json.loads(body)["content"]
            return self.answer({"errors": [], "warnings": []})
        if "/preupload/" in self.path:
            paths = [entry["path"] for entry in json.loads(body)["files"]]
            modes = {path: "lfs" if path.endswith(".safetensors") else "regular" for path in paths}
            files = [{"path": path, "uploadMode": mode, "shouldIgnore": False} for path, mode in modes.items()]
            return self.answer({"files": files})
        if self.path.endswith("/info/lfs/objects/batch"):
            objects = [
                {**one, "actions": {"upload": {"href": f"{hub.url}/blob/{one['oid']}"}}}
                for one in json.loads(body)["objects"]
            ]
            return self.answer({"transfer": "basic", "objects": objects})
        assert "/commit/" in self.path, self.path
        files = dict(hub.commits[hub.head]) if hub.head else {}
        for line in map(json.loads, body.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = hub.blobs[value["oid"]]
        hub.add_commit(files)
        commit_url = f"{hub.url}/me/traffic/commit/{hub.head}"
        return self.answer({"success": True, "commitOid": hub.head, "commitUrl": commit_url, "commitMessage": "m"})

    def do_PUT(self):
        self.server.blobs[self.path.rpartition("/")[2]] = self.read_body()
        self.answer(b"")

    def do_GET(self):
        hub, (path, _, _) = self.server, self.path.partition("?")
        hub.asked.append(f"{self.command} {path}")
        if "/me/traffic" not in path:
            return self.refuse("RepoNotFound")
        if "/revision/" in path or path.endswith("/api/models/me/traffic"):
            revision = path.partition("/revision/")[2] or "main"
            sha = hub.head if revision == "main" else revision
            if sha not in hub.commits:
                return self.refuse("RevisionNotFound")
            names = [{"rfilename": name} for name in hub.commits[sha]]
            return self.answer({"id": "me/traffic", "modelId": "me/traffic", "sha": sha, "siblings": names})
        if "/tree/" in path:
            files = hub.commits[path.partition("/tree/")[2]]
            return self.answer(
                [
                    {"type": "file", "path": name, "size": len(data), "oid": hashlib.sha1(data).hexdigest()}
                    for name, data in files.items()
                ]
            )
        sha, _, name = path.partition("/resolve/")[2].partition("/")
        if name not in hub.commits.get(sha, {}):
            return self.refuse("EntryNotFound")
        data = hub.commits[sha][name]
        length = str(len(data))
        if self.command == "GET" and hub.is_cut and name.endswith(".safetensors"):
            data, self.close_connection = data[: len(data) // 2], True
        etag = hashlib.sha256(hub.commits[sha][name]).hexdigest()
        headers = {"X-Repo-Commit": sha, "ETag": f'"{etag}"', "Content-Length": length}
        return self.answer(data, **headers)

    do_HEAD = do_GET


class HubServer(ThreadingHTTPServer):
    """State of the stand-in."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Hub)
        self.url = f"http://127.0.0.1:{self.server_port}"
        self.commits, self.head, self.blobs = {}, "", {}
        self.asked, self.card = [], ""
        self.is_cut = self.exists = False

    def add_commit(self, files):
        self.head = hashlib.sha1(repr(sorted(files.items())).encode()).hexdigest()
        self.commits[self.head] = files


@contextmanager
def serve():
    """The stand-in, while the block runs."""
    server = HubServer()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
