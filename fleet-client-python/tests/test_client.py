"""Tests the client of a cloud: with a server that plays one, and with the real program if it is
built."""

from __future__ import annotations

import hashlib
import http.client
import json
import os
import subprocess
import tempfile
import threading
import unittest
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Dict, List, Optional, Tuple, get_args
from unittest import mock

from gleaner_fleet import Clip, ClipState, Cloud, CloudError

CHECKOUT = Path(__file__).resolve().parents[2]
CONTENT = b"0123456789" * 100
DIGEST = hashlib.sha256(CONTENT).hexdigest()

Answer = Tuple[int, bytes]


def facts(**changes: Any) -> Dict[str, Any]:
    return {
        "id": "brake-1@car-7",
        "state": "stored",
        "bytes": len(CONTENT),
        "sha256": DIGEST,
        **changes,
    }


class FakeCloud(unittest.TestCase):
    """A server with set answers, which remembers requests."""

    def setUp(self) -> None:
        self.answers: Dict[str, Answer] = {}
        self.seen: List[Tuple[str, Dict[str, str]]] = []
        test = self

        class Handler(BaseHTTPRequestHandler):
            def answer(self) -> None:
                line = f"{self.command} {self.path}"
                test.seen.append((line, {key.lower(): it for key, it in self.headers.items()}))
                title = f"no answer to {line}"
                problem = {"title": title, "causes": ["a cause"], "help": "a help"}
                missing = (404, json.dumps(problem).encode())
                status, content = test.answers.get(line, missing)
                begin = self.headers.get("Range", "bytes=0-")[len("bytes=") : -1]
                if int(begin) > 0:
                    status, content = 206, content[int(begin) :]
                self.send_response(status)
                if status == 302:
                    self.send_header("Location", "http://127.0.0.1:1/")
                self.end_headers()
                self.wfile.write(content)

            do_GET = do_POST = answer

            def log_message(self, *_: Any) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        self.addCleanup(server.server_close)
        self.addCleanup(thread.join)
        self.addCleanup(server.shutdown)
        self.url = f"http://127.0.0.1:{server.server_address[1]}"
        self.cloud = Cloud(self.url, "secret")
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def set(self, line: str, content: Any, status: int = 200) -> None:
        self.answers[line] = (status, json.dumps(content).encode())

    def page(self, count: int, next: Optional[str]) -> Dict[str, Any]:
        return {"items": [{"name": f"car-{it}"} for it in range(count)], "next": next}

    def test_a_list_is_followed_to_its_end(self) -> None:
        self.set("GET /v1/vehicles?limit=500", self.page(500, "a&b"))
        self.set("GET /v1/vehicles?after=a%26b&limit=500", self.page(2, None))
        self.assertEqual(len(self.cloud.vehicles()), 502)
        self.assertEqual(self.seen[0][1]["authorization"], "Bearer secret")
        self.set("GET /v1/deployments?limit=500", self.page(3, "a"))
        with self.assertRaisesRegex(CloudError, "not full"):
            self.cloud.deployments()

    def test_an_error_has_its_cause_and_help_and_no_redirection_is_followed(self) -> None:
        text = "no answer to GET(.|\n)*a cause(.|\n)*a help"
        with self.assertRaisesRegex(CloudError, text) as it:
            self.cloud.status("car 7")
        self.assertEqual(it.exception.status, 404)
        self.assertEqual(self.seen[-1][0], "GET /v1/vehicles/car%207/status")
        self.answers["GET /v1/vehicles/car-7/status"] = (302, b"<html>")
        with self.assertRaisesRegex(CloudError, "302"):
            self.cloud.status("car-7")
        for name in ("", "..", "."):
            with self.assertRaises(ValueError):
                self.cloud.status(name)

    def test_records_are_read_line_by_line(self) -> None:
        path = "GET /v1/vehicles/car-7/lambdas/brake/records?follow=false&last=2"
        self.answers[path] = (200, b'{"seq":1}\n{"seq":2}\n')
        self.assertEqual([it["seq"] for it in self.cloud.records("car-7", "brake", 2)], [1, 2])
        self.answers["GET /v1/vehicles/car-7/events?follow=false"] = (200, b'{"seq":1}\n{"se')
        with self.assertRaisesRegex(CloudError, "cut off"):
            list(self.cloud.events("car-7"))

    def test_a_search_goes_on_after_a_part_without_records(self) -> None:
        path = "GET /v1/records?text=a+b&level=warn"
        self.set(path, {"items": [], "next": "x"})
        self.set(f"{path}&after=x", {"items": [{"vehicle": "car-7", "line": {}}], "next": None})
        found = list(self.cloud.search("a b", level="warn"))
        self.assertEqual([it["vehicle"] for it in found], ["car-7"])
        self.set(f"{path}&after=x", {"items": [], "next": "x"})
        with self.assertRaisesRegex(CloudError, "does not go on"):
            list(self.cloud.search("a b", level="warn"))

    def test_a_clip_is_chosen_pulled_and_downloaded_in_two_parts(self) -> None:
        query = "GET /v1/clips?lambda=brake&label=dark&from_ns=5&limit=1"
        self.set(query, {"items": [facts(state="on-vehicle")], "next": "7"})
        (clip,) = self.cloud.clips(function="brake", label="dark", from_ns=5, most=1)
        self.set("POST /v1/clips/brake-1@car-7/pull", facts(state="wanted"))
        self.set("GET /v1/clips/brake-1@car-7", facts())
        clip.pull(wait_s=5)
        self.assertEqual(clip.state, "stored")
        self.answers["GET /v1/clips/brake-1@car-7/thumbnail"] = (200, b"jpeg")
        self.assertEqual(clip.thumbnail(), b"jpeg")
        self.answers["GET /v1/clips/brake-1@car-7/file"] = (200, CONTENT[:300])
        with self.assertRaisesRegex(ConnectionError, "after 300 bytes"):
            clip.download(self.folder)
        self.answers["GET /v1/clips/brake-1@car-7/file"] = (200, CONTENT)
        path = clip.download(self.folder)
        self.assertEqual(path, self.folder / "car-7" / "brake-1.mcap")
        self.assertEqual(path.read_bytes(), CONTENT)
        self.assertEqual(self.seen[-1][1]["range"], "bytes=300-")
        self.assertEqual([it.name for it in path.parent.iterdir()], [path.name])
        count = len(self.seen)
        self.assertEqual(clip.download(self.folder), path)
        self.assertEqual(len(self.seen), count, "it is there")

    def test_another_file_or_place_is_refused(self) -> None:
        clip = Clip(self.cloud, facts())
        self.answers["GET /v1/clips/brake-1@car-7/file"] = (200, CONTENT[::-1] + b"more")
        with self.assertRaisesRegex(CloudError, "another file"):
            clip.download(self.folder)
        path = self.folder / "car-7" / "brake-1.mcap"
        self.assertEqual(list(path.parent.iterdir()), [])
        path.write_bytes(b"mine")
        with self.assertRaises(FileExistsError):
            clip.download(self.folder)
        self.assertEqual(path.read_bytes(), b"mine")
        path.unlink()
        (path.parent / "brake-1.mcap.part").symlink_to("/etc/passwd")
        with self.assertRaises(OSError):
            clip.download(self.folder)
        for id in ("../a@car-7", "a@../car-7", "a", "@", ".a@car-7", None):
            with self.assertRaises(CloudError):
                Clip(self.cloud, facts(id=id))

    def test_the_address_and_the_token_are_those_of_the_command(self) -> None:
        file = self.folder / "gleaner" / "cloud.json"
        file.parent.mkdir()
        file.write_text(json.dumps({"url": self.url, "token": "stored"}))
        self.set("GET /v1/vehicles?limit=500", self.page(0, None))
        environment = {"XDG_CONFIG_HOME": str(self.folder)}
        with mock.patch.dict(os.environ, environment, clear=True):
            file.chmod(0o644)
            with self.assertRaisesRegex(ValueError, "other users"):
                Cloud()
            file.chmod(0o600)
            Cloud().vehicles()
            self.assertEqual(self.seen[-1][1]["authorization"], "Bearer stored")
            with self.assertRaisesRegex(ValueError, "no token for http://other:1"):
                Cloud("http://other:1")
            file.unlink()
            with self.assertRaisesRegex(ValueError, "gleaner login"):
                Cloud()
        for url in ("ftp://a", "http://", "http://a/b", "http://u@a", "127.0.0.1:8080"):
            with self.assertRaises(ValueError):
                Cloud(url, "t")


class RealCloud(unittest.TestCase):
    def test_the_real_cloud_answers(self) -> None:
        program = os.environ.get("GLEANER_CLOUD_PROGRAM")
        path = Path(program) if program else CHECKOUT / "target" / "release" / "gleaner-cloud"
        if not path.is_file():
            self.skipTest(f"{path} is not built")
        with tempfile.TemporaryDirectory() as folder:
            any_port = ["--http", "127.0.0.1:0", "--vehicles", "127.0.0.1:0"]
            command = [str(path), "serve", "--data", f"{folder}/data", *any_port]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
                try:
                    self.use(server)
                finally:
                    server.terminate()

    def use(self, server: subprocess.Popen[str]) -> None:
        assert server.stdout is not None
        words: List[str] = []
        for line in server.stdout:
            words += line.split()
            if "--code" in words[:-1]:
                break
        url = next(word for word in words if word.startswith("http://")).rstrip("/")
        code = words[words.index("--code") + 1]
        connection = http.client.HTTPConnection(url[len("http://") :])
        self.addCleanup(connection.close)

        def post(path: str, body: Dict[str, str], token: str) -> Any:
            headers = {"Authorization": f"Bearer {token}"}
            connection.request("POST", path, json.dumps(body), headers)
            return json.load(connection.getresponse())

        connection.request("GET", "/v1/openapi.json")
        schemas = json.load(connection.getresponse())["components"]["schemas"]
        states = schemas["ClipState"]["oneOf"]
        self.assertEqual(tuple(state["const"] for state in states), get_args(ClipState))
        token = post("/v1/login", {"code": code}, "")["token"]
        cloud = Cloud(url, token)
        self.assertEqual((cloud.vehicles(), cloud.deployments(), cloud.clips()), ([], [], []))
        with self.assertRaisesRegex(CloudError, "there is no vehicle `car-7`"):
            cloud.status("car-7")
        post("/v1/vehicles", {"name": "car-7"}, token)
        self.assertEqual([it["state"] for it in cloud.vehicles()], ["invited"])
        with self.assertRaisesRegex(CloudError, "there is no clip"):
            cloud.clip("a@car-7")
        self.assertEqual(list(cloud.events("car-7", last=1)), [])
