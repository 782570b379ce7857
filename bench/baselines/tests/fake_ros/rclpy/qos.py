from types import SimpleNamespace
from typing import Any

HistoryPolicy = SimpleNamespace(KEEP_LAST=1)
ReliabilityPolicy = SimpleNamespace(RELIABLE=1)
DurabilityPolicy = SimpleNamespace(VOLATILE=2)


def QoSProfile(*, history: Any, depth: int, reliability: Any, durability: Any) -> None:
    pass
