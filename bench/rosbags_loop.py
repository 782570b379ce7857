"""Baseline without Gleaner: reads a drive with rosbags, parses each IMU message, and calls the
example's function on the last half second.

Prints one JSON object: messages, hits, and seconds from the first message to the last. The function
is imported from `examples/hello/python/main.py`; the loop is what a careful script would do: one
topic, a ring in numpy."""
from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from gleaner import Column

DEPTH = 512


def main(drive: str, lambda_dir: str, brake_mps2: float) -> None:
    sys.path.insert(0, lambda_dir)
    import main as hello

    at_ns, values = np.zeros(2 * DEPTH, np.int64), np.zeros(2 * DEPTH)
    end = messages = hits = 0
    last_ns = None
    with AnyReader([Path(drive)]) as reader:
        connections = [one for one in reader.connections if one.topic == "/imu/data"]
        started = time.perf_counter()
        for connection, now, raw in reader.messages(connections=connections):
            message = reader.deserialize(raw, connection.msgtype)
            if end == 2 * DEPTH:
                at_ns[:DEPTH], values[:DEPTH], end = at_ns[DEPTH:], values[DEPTH:], DEPTH
            at_ns[end], values[end] = now, message.linear_acceleration.x
            end += 1
            begin = max(end - DEPTH, 0)
            begin += int(np.searchsorted(at_ns[begin:end], now - hello.WINDOW_NS, side="right"))
            mean = hello.braking(Column(at_ns[begin:end], values[begin:end]), now, brake_mps2)
            if mean is not None and (last_ns is None or now - last_ns >= hello.REFRACTORY_NS):
                last_ns, hits = now, hits + 1
            messages += 1
        seconds = time.perf_counter() - started
    print(json.dumps({"messages": messages, "hits": hits, "seconds": seconds}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
