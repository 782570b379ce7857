"""Requests to the cloud of a fleet.

What comes from the cloud is bounded and checked: names lead out of no folder, lists and answers
end, and a file counts only with the digest that its vehicle has announced.
"""

from __future__ import annotations

import fcntl
import hashlib
import http.client
import json
import os
import re
import stat
import time
from pathlib import Path
from typing import Any, BinaryIO, Dict, Iterator, List, Literal, Mapping, Optional, Tuple, Union
from urllib.parse import quote, urlencode, urlsplit

ANSWER_MAX = 64 << 20
"""Longest answer, and longest line of one, in bytes."""

LIST_MAX = 512 << 20
"""Maximum length of all parts of a list together, in bytes."""

ENTRIES_MAX = 100_000
"""Maximum number of entries of a list."""

PART = 500
"""Maximum number of entries in a part of a list."""

PIECE = 1 << 20

NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,255}")

ClipState = Literal["on-vehicle", "wanted", "uploading", "stored", "gone", "failed"]
"""The place of a clip's file, as the cloud's description of its API lists them."""


class CloudError(Exception):
    """An answer of a cloud that is an error, or that cannot be used."""

    def __init__(self, status: int, title: str, causes: List[str], help: Optional[str]) -> None:
        lines = [title, *(f"cause: {cause}" for cause in causes)]
        super().__init__(_shown("\n".join(lines + ([f"help: {help}"] if help else []))))
        self.status, self.title, self.causes, self.help = status, title, causes, help


class Cloud:
    """A cloud, as a user with a token.

    Without ``url`` and ``token``, they are those of ``gleaner login``: of the variables
    ``GLEANER_CLOUD`` and ``GLEANER_CLOUD_TOKEN``, or of the file of the command. ``timeout`` is
    the longest wait for a connection, and for each piece of an answer, in s.
    """

    def __init__(
        self, url: Optional[str] = None, token: Optional[str] = None, timeout: float = 30.0
    ) -> None:
        if url is None or token is None:
            url, token = _account(url, token)
        parts = urlsplit(url)
        has_more = parts.path not in ("", "/") or parts.query or parts.fragment or parts.username
        if parts.scheme not in ("http", "https") or not parts.hostname or has_more:
            raise ValueError(f"{url!r} is not http://HOST:PORT, as in http://127.0.0.1:8080")
        self._is_tls, self._place = parts.scheme == "https", (parts.hostname, parts.port)
        self._token, self._timeout = token, timeout

    def __repr__(self) -> str:
        return f"Cloud({self._place[0]!r})"

    def vehicles(self) -> List[Dict[str, Any]]:
        """All vehicles, by name."""
        return self._list("/v1/vehicles", {}, None)

    def deployments(self) -> List[Dict[str, Any]]:
        """All deployments, by id."""
        return self._list("/v1/deployments", {}, None)

    def status(self, vehicle: str) -> Dict[str, Any]:
        """The last report of a vehicle."""
        return self._json("GET", f"/v1/vehicles/{_part(vehicle)}/status")

    def events(
        self, vehicle: str, last: Optional[int] = None, follow: bool = False
    ) -> Iterator[Dict[str, Any]]:
        """Events of a vehicle, the oldest first: all that are kept, or the ``last`` ones.

        With ``follow``, it goes on with new ones until the cloud ends, or until none came for
        ``timeout``: that raises an OSError.
        """
        return self._lines(f"/v1/vehicles/{_part(vehicle)}/events", last, follow)

    def records(
        self, vehicle: str, deployment: str, last: Optional[int] = None, follow: bool = False
    ) -> Iterator[Dict[str, Any]]:
        """Log lines and triggers of a deployment on a vehicle, as ``events``."""
        path = f"/v1/vehicles/{_part(vehicle)}/lambdas/{_part(deployment)}/records"
        return self._lines(path, last, follow)

    def search(
        self,
        text: str = "",
        vehicle: Optional[str] = None,
        label: Optional[str] = None,
        function: Optional[str] = None,
        kind: Optional[str] = None,
        level: Optional[str] = None,
        from_ns: Optional[int] = None,
        to_ns: Optional[int] = None,
    ) -> Iterator[Dict[str, Any]]:
        """Records with ``text`` in a value, each with its ``vehicle`` and its ``line``.

        Those of a vehicle come newest first, one vehicle after the other. ``label`` is one of the
        vehicle, as in ``site=berlin``, ``function`` the id of a deployment, and ``level`` the
        least of a log line. Without a bound, read as many as you need, and stop.
        """
        first = _query(text=text or None, vehicle=vehicle, label=label, function=function)
        query = {**first, **_query(kind=kind, level=level, from_ns=from_ns, to_ns=to_ns)}
        while True:
            path = f"/v1/records?{urlencode(query)}"
            part = self._json("GET", path)
            items, more = part.get("items"), part.get("next")
            if not isinstance(items, list) or not all(isinstance(it, dict) for it in items):
                raise _bad(f"the answer to {path} has no records of the right form")
            yield from items
            if more is None:
                return
            if not isinstance(more, str) or more == query.get("after"):
                raise _bad(f"the answer to {path} does not go on")
            query["after"] = more

    def clips(
        self,
        vehicle: Optional[str] = None,
        function: Optional[str] = None,
        label: Optional[str] = None,
        from_ns: Optional[int] = None,
        to_ns: Optional[int] = None,
        most: Optional[int] = None,
    ) -> List[Clip]:
        """Clips, the last announced first: all that match, or the first ``most``.

        ``function`` is the name of a lambda; times are in ns since 1970.
        """
        chosen = {"vehicle": vehicle, "function": function, "label": label}
        query = _query(**chosen, from_ns=from_ns, to_ns=to_ns)
        return [Clip(self, facts) for facts in self._list("/v1/clips", query, most)]

    def clip(self, id: str) -> Clip:
        """The clip with this id: ``NAME@VEHICLE``."""
        return Clip(self, self._json("GET", f"/v1/clips/{_part(id)}")).must_be(id)

    def _list(
        self, path: str, query: Mapping[str, str], most: Optional[int]
    ) -> List[Dict[str, Any]]:
        entries: List[Dict[str, Any]] = []
        size = 0
        wanted = ENTRIES_MAX + 1 if most is None else most
        after: Dict[str, str] = {}
        while len(entries) < wanted:
            limit = min(PART, wanted - len(entries))
            values = {**query, **after, "limit": str(limit)}
            content = self._bytes("GET", f"{path}?{urlencode(values)}")
            size += len(content)
            if size > LIST_MAX:
                raise _bad(f"the list {path} has more than {LIST_MAX} bytes")
            part = _parsed(content, path)
            items, more = part.get("items"), part.get("next")
            if not isinstance(items, list) or not all(isinstance(it, dict) for it in items):
                raise _bad(f"the list {path} has no entries of the right form")
            entries.extend(items)
            if more is None:
                break
            if len(items) < limit or not isinstance(more, str):
                raise _bad(f"the list {path} goes on after a part that is not full")
            after = {"after": more}
        if most is None and len(entries) > ENTRIES_MAX:
            raise _bad(f"the list {path} has more than {ENTRIES_MAX} entries")
        return entries[:wanted]

    def _lines(self, path: str, last: Optional[int], follow: bool) -> Iterator[Dict[str, Any]]:
        values = _query(follow="true" if follow else "false", last=last)
        answer, close = self._open("GET", f"{path}?{urlencode(values)}", {})
        try:
            while True:
                line = answer.readline(ANSWER_MAX + 1)
                if not line:
                    return
                if not line.endswith(b"\n"):
                    raise _bad(f"a line of {path} is cut off, or too long")
                yield _parsed(line, path)
        finally:
            close.close()

    def _json(self, method: str, path: str) -> Dict[str, Any]:
        return _parsed(self._bytes(method, path), path)

    def _bytes(self, method: str, path: str) -> bytes:
        answer, connection = self._open(method, path, {})
        try:
            return _whole(answer, path)
        finally:
            connection.close()

    def _open(
        self, method: str, path: str, headers: Mapping[str, str]
    ) -> Tuple[http.client.HTTPResponse, http.client.HTTPConnection]:
        kind = http.client.HTTPSConnection if self._is_tls else http.client.HTTPConnection
        host, port = self._place
        connection = kind(host, port, timeout=self._timeout)
        try:
            own = {"Authorization": f"Bearer {self._token}", **headers}
            # A redirection is not followed: the token is for this address only.
            connection.request(method, path, headers=own)
            answer = connection.getresponse()
            if answer.status not in (200, 206):
                raise _problem(answer.status, _whole(answer, path))
        except BaseException:
            connection.close()
            raise
        return answer, connection


class Clip:
    """A clip of a vehicle; ``facts`` has all that the cloud stated of it in the last answer."""

    def __init__(self, cloud: Cloud, facts: Dict[str, Any]) -> None:
        self._cloud, self.facts = cloud, facts
        name, _, vehicle = str(facts.get("id")).rpartition("@")
        if not NAME.fullmatch(name) or not NAME.fullmatch(vehicle):
            raise _bad(f"{facts.get('id')!r} is not a clip id")
        types = {"state": str, "bytes": int}
        if not all(isinstance(facts.get(key), kind) for key, kind in types.items()):
            raise _bad(f"clip {name}@{vehicle} has no state or no length")
        self._name, self._vehicle = name, vehicle

    def must_be(self, id: str) -> Clip:
        """Itself, if it has this id; raises CloudError for another clip."""
        if self.id != id:
            raise _bad(f"the cloud answers with clip {self.id} in the place of {id!r}")
        return self

    def __repr__(self) -> str:
        return f"<Clip {self.id}: {self.state}>"

    @property
    def id(self) -> str:
        """Its id: ``NAME@VEHICLE``."""
        return f"{self._name}@{self._vehicle}"

    @property
    def state(self) -> ClipState:
        """The place of its file. A newer cloud may have further ones."""
        state: ClipState = self.facts["state"]
        return state

    def refresh(self) -> None:
        """Gets its facts again."""
        self.facts = self._cloud.clip(self.id).facts

    def pull(self, wait_s: float = 0.0) -> None:
        """Marks its file as wanted, and waits for at most ``wait_s`` until the cloud has it."""
        pulled = self._cloud._json("POST", f"{self._path}/pull")
        self.facts = Clip(self._cloud, pulled).must_be(self.id).facts
        until = time.monotonic() + wait_s
        while self.state in ("on-vehicle", "wanted", "uploading") and time.monotonic() < until:
            time.sleep(min(2.0, max(0.0, until - time.monotonic())))
            self.refresh()

    def thumbnail(self) -> bytes:
        """A JPEG of it. Raises CloudError without one."""
        return self._cloud._bytes("GET", f"{self._path}/thumbnail")

    def download(self, folder: Union[str, Path]) -> Path:
        """Downloads its file as ``FOLDER/VEHICLE/NAME.mcap``; returns the path.

        After an interruption, the next call goes on where it was. Raises CloudError if the file is
        not in the cloud, or is not the one that the vehicle has announced, and FileExistsError if
        there is another file in its place.
        """
        length, digest = int(self.facts["bytes"]), self.facts["sha256"]
        path = Path(folder) / self._vehicle / f"{self._name}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path):
            with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW), "rb") as file:
                if _sha256(file) != digest:
                    raise FileExistsError(f"{path} exists, and is another file")
            return path
        part = path.with_suffix(".mcap.part")
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
        with open(os.open(part, flags, 0o644), "r+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if file.seek(0, os.SEEK_END) > length:
                file.truncate(0)
            self._append(file, length)
            os.fsync(file.fileno())
            file.seek(0)
            if _sha256(file) != digest:
                part.unlink()
                raise _bad(f"the cloud sent another file than clip {self.id}")
            # Unlike a rename, it replaces nothing.
            os.link(part, path)
            part.unlink()
        return path

    def _append(self, file: BinaryIO, length: int) -> None:
        begin = file.seek(0, os.SEEK_END)
        if begin == length:
            return
        headers = {"Range": f"bytes={begin}-"} if begin else {}
        answer, connection = self._cloud._open("GET", f"{self._path}/file", headers)
        try:
            if begin and answer.status != 206:
                raise _bad("the cloud does not continue a file")
            while begin < length:
                piece = answer.read(min(PIECE, length - begin))
                if not piece:
                    raise ConnectionError(f"clip {self.id} is cut off after {begin} bytes")
                file.write(piece)
                begin += len(piece)
        finally:
            file.flush()
            connection.close()

    @property
    def _path(self) -> str:
        return f"/v1/clips/{_part(self.id)}"


def _query(**values: Union[str, int, None]) -> Dict[str, str]:
    """The values that are set. ``lambda`` is a keyword of Python, so it is ``function`` here."""
    given = {key: str(value) for key, value in values.items() if value is not None}
    return {"lambda" if key == "function" else key: value for key, value in given.items()}


def _part(name: str) -> str:
    """A part of a path."""
    if name in ("", ".", ".."):
        raise ValueError(f"{name!r} is no name")
    return quote(name, safe="@")


def _sha256(file: BinaryIO) -> str:
    digest = hashlib.sha256()
    for piece in iter(lambda: file.read(PIECE), b""):
        digest.update(piece)
    return digest.hexdigest()


def _whole(answer: http.client.HTTPResponse, path: str) -> bytes:
    content = answer.read(ANSWER_MAX + 1)
    if len(content) > ANSWER_MAX:
        raise _bad(f"the answer to {path} has more than {ANSWER_MAX} bytes")
    return content


def _parsed(content: bytes, path: str) -> Dict[str, Any]:
    try:
        found = json.loads(content)
    except (ValueError, RecursionError):
        raise _bad(f"the answer to {path} cannot be read") from None
    if not isinstance(found, dict):
        raise _bad(f"the answer to {path} has another form")
    return found


def _shown(text: str) -> str:
    """A text without characters that would control a terminal."""
    return "".join(it if it.isprintable() or it == "\n" else "?" for it in text)


def _bad(reason: str) -> CloudError:
    return CloudError(0, reason, [], None)


def _problem(status: int, content: bytes) -> CloudError:
    try:
        problem = json.loads(content)
        causes = [str(cause) for cause in problem.get("causes", [])]
        return CloudError(status, str(problem["title"]), causes, problem.get("help"))
    except (ValueError, RecursionError, KeyError, AttributeError, TypeError):
        return CloudError(status, f"the cloud answers {status}", [], None)


def _account(url: Optional[str], token: Optional[str]) -> Tuple[str, str]:
    """Address and token: those that are given, of the environment, or of ``gleaner login``."""
    url = url or os.environ.get("GLEANER_CLOUD") or None
    token = token or os.environ.get("GLEANER_CLOUD_TOKEN") or None
    if url and token:
        return url, token
    config = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    path = config / "gleaner" / "cloud.json"
    try:
        mode = path.stat().st_mode
        account = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        reason = "not logged in to a cloud: `gleaner login URL --code CODE`"
        raise ValueError(reason) from None
    if stat.S_IMODE(mode) & 0o077:
        raise ValueError(f"other users can read the token in {path}: `chmod 600 {path}`")
    # The token must not reach another cloud.
    if url and url.rstrip("/") != account["url"]:
        raise ValueError(f"there is no token for {url}, but one for {account['url']}")
    return account["url"], token or account["token"]
