"""A baseline as a program: its command line, its lines on standard output, and its end. The
middleware is in a node, which the caller of `run` makes.

A line is a JSON object. The first one has `ready`, the last one the counts. Where a library is
missing or fails, the only line has `skipped`, and the exit code is 3.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import select
import signal
import socket
import stat
import sys
import threading
import time
from importlib import metadata
from typing import Any, Callable, Container, Dict, List, NoReturn, Optional, Protocol, Tuple, Type

WRONG_USE = 2
"""Exit code of a wrong command line, as of `argparse`."""

SKIPPED = 3
"""Exit code of a baseline that cannot run on this machine."""

GRACE_S = 5.0
"""Time for the middleware to return at the end. It once stayed in a wait until the next message."""


class Node(Protocol):
    """A stack that serves a workload: it reads the inputs and writes the answers."""

    stack: str
    """Name and version of the stack."""

    def spin(self) -> None:
        """Answers messages until another thread has called `stop`."""

    def stop(self) -> None:
        """Lets `spin` return soon."""

    def lost(self) -> Optional[int]:
        """Returns the number of messages that the stack counted as lost; None if it counts none."""

    def close(self) -> None:
        """Leaves the network."""


def run(
    workloads: Any,
    open_node: Callable[[argparse.Namespace, Any, Tally], Node],
    packages: Tuple[str, ...],
    errors: Tuple[Type[Exception], ...] = (),
) -> None:
    """Runs a baseline from its command line to its end. `packages` are those whose versions it
    states, `errors` those of the middleware."""
    options = parse(workloads.CONFIG, workloads.WITH_IMAGES)
    end = End()
    try:
        # A failure, such as of an old library, becomes known here and not in a measurement.
        workloads.probe(workloads.workload(options.workload, options.config))
        workload = workloads.workload(options.workload, options.config)
    except workloads.SettingError as error:
        fail("cannot configure the workload", error, "see [config] of the lambda", WRONG_USE)
    except Exception as error:
        skip(error, f"cannot run workload `{options.workload}`")
    tally = Tally(options.name)
    try:
        node = open_node(options, workload, tally)
    except errors as error:
        fail(
            "cannot join DDS",
            error,
            "check CYCLONEDDS_URI and ROS_DOMAIN_ID, and that a network interface is up",
        )
    tally.ready(
        stack=node.stack,
        workload=options.workload,
        config=options.config,
        depth=options.depth,
        luma=getattr(workload, "luma", None),
        model=getattr(workload, "runtime", None),
        versions=versions(*packages),
    )
    try:
        end.run(node.spin, node.stop, lambda: tally.last(node.lost()))
    except errors + (ValueError,) as error:
        inputs = " and ".join(filter(None, (options.input, options.image)))
        fail(f"cannot answer {inputs}", error, "send the types that `--help` lists; see README.md")
    node.close()


def skip(error: Exception, what: str = "cannot start the node") -> NoReturn:
    """Ends the program because a library is missing or fails."""
    cause = f"{type(error).__name__}: {' '.join(str(error).split())}"
    line(skipped=f"{what}: {cause}; bench/baselines/README.md lists what it needs")
    sys.exit(SKIPPED)


def line(**values: Any) -> None:
    """Prints a line."""
    print(json.dumps(values), flush=True)


def fail(what: str, error: BaseException, help_text: str, code: int = 1) -> NoReturn:
    """Ends the program because of an error."""
    cause = " ".join(str(error).split()) or type(error).__name__
    print(f"error: {what}\n  cause: {cause}\n  help:  {help_text}", file=sys.stderr)
    sys.exit(code)


def parse(
    workloads: Any, with_images: Container[str], arguments: Optional[List[str]] = None
) -> argparse.Namespace:
    """Parses the command line; `workloads` are the names of the workloads, `with_images` those that
    wake on images. Ends the program with exit code 2 if it is wrong."""
    parser = argparse.ArgumentParser(description="Answers each message that wakes a workload.")
    parser.add_argument("workload", choices=list(workloads))
    parser.add_argument("--input", required=True, metavar="TOPIC", help="sensor_msgs/Imu")
    parser.add_argument("--image", metavar="TOPIC", help="sensor_msgs/Image")
    parser.add_argument(
        "--answers", required=True, metavar="TOPIC", help="sensor_msgs/TimeReference"
    )
    parser.add_argument("--depth", type=int, default=10, metavar="N", help="KeepLast(N) of topics")
    parser.add_argument("--name", help="first part of `source` in answers; the workload's name")
    parser.add_argument(
        "--config",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="as in [config] of the lambda; may be repeated",
    )
    options = parser.parse_args(arguments)
    for topic in (options.input, options.image, options.answers):
        if topic is not None and not topic.startswith("/"):
            parser.error(f"topic `{topic}` is not absolute: begin it with `/`")
    if (options.workload in with_images) != (options.image is not None):
        need = "needs" if options.image is None else "takes no"
        parser.error(f"workload `{options.workload}` {need} --image")
    if options.depth < 1:
        parser.error(f"--depth {options.depth} keeps no message: use 1 or more")
    if options.name is None:
        options.name = options.workload
    return options


class Tally:
    """Counts of the messages that wake a workload, and of the answers."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.received = 0
        self.answered = 0
        self._cpu_s = 0.0

    def source(self, labels: Any) -> str:
        """`source` of the next answer, as that of a lambda: NAME:NUMBER:LABEL,LABEL."""
        return f"{self.name}:{self.answered}:{','.join(labels)}"

    def ready(self, **values: Any) -> None:
        """Prints the first line. The CPU time counts from now on."""
        self._cpu_s = time.process_time()
        line(ready=True, **values, python=sys.version.split()[0], socket_buffer=socket_buffer())

    def last(self, lost: Optional[int]) -> None:
        """Prints the last line."""
        line(
            received=self.received,
            answered=self.answered,
            lost=lost,
            cpu_s=round(time.process_time() - self._cpu_s, 6),
            rss_kib=rss_kib(),
        )


def versions(*packages: str) -> Dict[str, str]:
    """Versions of the installed ones of `packages`."""
    found = {}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def rss_kib() -> int:
    """Resident memory of this process in KiB."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize() // 1024


def socket_buffer() -> Optional[int]:
    """Largest receive buffer, in bytes, that the kernel granted one of the bound UDP sockets of
    this process; None without such a socket.

    Cyclone DDS requests the same size for all sockets that it reads. The kernel reports twice the
    granted size."""
    sizes = []
    for name in os.listdir("/proc/self/fd"):
        try:
            if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                continue
            with socket.socket(fileno=os.dup(int(name))) as duplicate:
                internet = duplicate.family in (socket.AF_INET, socket.AF_INET6)
                datagrams = duplicate.type & socket.SOCK_DGRAM
                if internet and datagrams and duplicate.getsockname()[1] != 0:
                    sizes.append(duplicate.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2)
        except OSError:
            # Closed since it was listed, such as the descriptor of the listing itself.
            continue
    return max(sizes, default=None)


class End:
    """The end of the program: SIGINT, SIGTERM, or the end of standard input where that is a pipe, a
    socket or a terminal.

    A thread waits for it, since a handler in Python would run only when the main thread comes back
    from the middleware."""

    def __init__(self) -> None:
        self.signals, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)

    def run(
        self, spin: Callable[[], None], stop: Callable[[], None], last: Callable[[], None]
    ) -> None:
        """Calls `spin`, which returns soon after another thread has called `stop` at the end, and
        then `last`. If `spin` does not return in `GRACE_S`, the program ends without it."""
        printed = threading.Event()

        def watch() -> None:
            self._wait()
            stop()
            if not printed.wait(GRACE_S):
                last()
                os._exit(0)

        threading.Thread(target=watch, name="end", daemon=True).start()
        spin()
        printed.set()
        last()

    def _wait(self) -> None:
        watched = [self.signals] + ([0] if ends(0) else [])
        while True:
            ready, _, _ = select.select(watched, [], [])
            if self.signals in ready or not os.read(0, 4096):
                return


def ends(descriptor: int) -> bool:
    """Returns whether the end of a descriptor means the end of its writer: not for a file."""
    try:
        mode = os.fstat(descriptor).st_mode
    except OSError:
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) or os.isatty(descriptor)
