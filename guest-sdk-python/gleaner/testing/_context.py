"""The context that a lambda gets at each call."""

from __future__ import annotations

from typing import Any, Dict, List, Mapping

from ..data import DataError
from ._data import InputState, Topic
from ._error import quoted
from ._session import Scratch, Session


class Context:
    """The context of one instance of a lambda. A fresh instance gets a new one, over the same
    session."""

    def __init__(
        self,
        session: Session,
        sources: List[InputState],
        config: Mapping[str, Any],
        scratch: Scratch,
    ) -> None:
        self._session = session
        self._topics = {source.declared.name: Topic(source) for source in sources}
        self._config: Dict[str, Any] = dict(config)
        self._scratch = scratch
        self._missed = 0

    @property
    def config(self) -> Mapping[str, Any]:
        return self._config

    @property
    def scratch(self) -> Scratch:
        return self._scratch

    @property
    def missed(self) -> int:
        return self._missed

    def input(self, name: str) -> Topic:
        if name not in self._topics:
            raise DataError(
                f"no input `{str(name)[:64]}`; the manifest has {quoted(self._topics)}",
                "no-such-input",
            )
        return self._topics[name]

    def inputs(self) -> List[str]:
        return list(self._topics)

    def now_ns(self) -> int:
        return self._session.now_ns

    def event(self, label: str, score: float, /, **attributes: Any) -> None:
        if isinstance(score, (str, bytes)):
            raise TypeError(f"must be real number, not {type(score).__name__}")
        self._session.cause("event", label, float(score), attributes)

    def start(self, label: str, /, **attributes: Any) -> None:
        self._session.cause("start", label, None, attributes)

    def stop(self, label: str, /) -> None:
        self._session.cause("stop", label, None, {})

    def log(self, level: str, message: str) -> None:
        self._session.log(level, message)


def set_missed(context: Context, ticks: int) -> None:
    """Sets the ``missed`` of a lambda's context."""
    context._missed = ticks
