"""Attacks its environment, once, in its third wake.

An event reports the outcome: `refused` with the error, or `escaped`.

For a bench it attacks repeatedly instead: in every other interval of `every_ms` milliseconds of the
wall clock. Two good wakes precede each attack that is a fault, which prevents back-off."""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import resource
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from typing import Callable, List, Tuple

from gleaner import Context

KEPT: List[object] = []

# Names of shared memory, in `/proc/self/maps`: a topic, and the page by which the ingress learns
# which samples this process holds.
TOPIC = "gleaner-topic"
CONTROL = "gleaner-control"


def mapped(access: str, name: str) -> Tuple[int, int]:
    """Address and length of the first shared memory with this access and name."""
    with open("/proc/self/maps") as maps:
        for line in maps:
            if access in line and name in line:
                start, end = (int(address, 16) for address in line.split()[0].split("-"))
                return start, end - start
    raise LookupError(f"no memory {name} is mapped as {access}")


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.attack: str = ctx.config["attack"]
        self.target: int = ctx.config["target"]
        self.every_ms: int = ctx.config["every_ms"]
        self.touch_mib: int = ctx.config["touch_mib"]
        self.wakes = 0
        # Objects of the previous attack, which ended in re-initialisation.
        KEPT.clear()

    def on_tick(self, ctx: Context) -> None:
        self.wakes += 1
        if not self.is_due(ctx) or self.attack == "none":
            return
        attack: Callable[[Context], object] = getattr(self, self.attack)
        try:
            result = attack(ctx)
        except (OSError, ValueError) as error:
            ctx.event("refused", 1.0, why=repr(error)[:200])
        else:
            ctx.event("escaped", 1.0, found=repr(result)[:200])

    def is_due(self, ctx: Context) -> bool:
        if self.every_ms == 0:
            return self.wakes == 3
        return self.wakes >= 3 and ctx.now_ns() // (self.every_ms * 1_000_000) % 2 == 1

    def endless(self, ctx: Context) -> None:
        while True:
            pass

    def host_calls(self, ctx: Context) -> None:
        while True:
            ctx.now_ns()

    def recurse(self, ctx: Context) -> None:
        self.recurse(ctx)

    def memory(self, ctx: Context) -> None:
        while True:
            KEPT.append(bytearray(1 << 20))

    def read_only_memory(self, ctx: Context) -> None:
        """Memory that is filled and then made read-only no longer counts for RLIMIT_DATA."""
        libc = ctypes.CDLL(None, use_errno=True)
        libc.mmap.restype = ctypes.c_void_p
        size, private_anonymous, writable, readable = 16 << 20, 0x22, 3, 1
        for _ in range(6):
            place = libc.mmap(None, ctypes.c_size_t(size), writable, private_anonymous, -1, 0)
            place = ctypes.c_void_p(place)
            ctypes.memset(place, 1, size)
            libc.mprotect(place, ctypes.c_size_t(size), readable)

    def page_tables(self, ctx: Context) -> None:
        """Reads a page in each 2 MiB of addresses: zeros, each with its own page table."""
        libc = ctypes.CDLL(None, use_errno=True)
        libc.mmap.restype = ctypes.c_void_p
        size, private_anonymous, readable = 64 << 30, 0x22, 1
        place = libc.mmap(None, ctypes.c_size_t(size), readable, private_anonymous, -1, 0)
        for page in range(place, place + size, 2 << 20):
            ctypes.string_at(page, 1)

    def threads(self, ctx: Context) -> None:
        """Starts as many threads as possible, each with a small stack."""
        threading.stack_size(32 << 10)
        for _ in range(2000):
            threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()

    def full(self, ctx: Context) -> None:
        """Keeps all available memory, and leaves the host too little for a log line."""
        line = "x" * 4000
        pieces: List[List[bytearray]] = [[] for _ in range(5)]
        KEPT.append(pieces)
        for piece, size in zip(pieces, (1 << 20, 1 << 16, 4100, 600, 64)):
            try:
                while True:
                    piece.append(bytearray(size))
            except MemoryError:
                pass
        while True:
            # Enough for the bytes of the line in Python, not for those in the host.
            pieces[2].pop()
            ctx.log("info", line)

    def touch(self, ctx: Context) -> None:
        """Writes all of its memory over and over: load for caches and the memory bus."""
        pieces = [bytearray(1 << 20) for _ in range(self.touch_mib)]
        ones = bytes([1]) * (1 << 20)
        while True:
            for piece in pieces:
                piece[:] = ones

    def numpy(self, ctx: Context) -> None:
        """Keeps its core busy in native code, which rarely returns to the interpreter."""
        import numpy

        a = numpy.ones((256, 256))
        while True:
            a = a @ a * 0.0 + 1.0

    def log_flood(self, ctx: Context) -> None:
        for i in range(5000):
            ctx.log("info", "x" * 100)

    def event_flood(self, ctx: Context) -> None:
        for i in range(5000):
            ctx.event("flood", 1.0)

    def fork(self, ctx: Context) -> int:
        if os.fork() == 0:
            while True:
                os.fork()
        return 1

    def program(self, ctx: Context) -> object:
        return subprocess.run(["/bin/true"], check=True)

    def read_passwd(self, ctx: Context) -> str:
        with open("/etc/passwd") as file:
            return file.read()

    def read_memory(self, ctx: Context) -> bytes:
        with open(f"/proc/{self.target}/mem", "rb") as file:
            return file.read(1)

    def socket(self, ctx: Context) -> object:
        return socket.socket(socket.AF_INET, socket.SOCK_STREAM)

    def connect(self, ctx: Context) -> object:
        return socket.create_connection(("127.0.0.1", 9))

    def write_outside(self, ctx: Context) -> int:
        with open("/tmp/gleaner-escaped", "w") as file:
            return file.write("here I was")

    def results(self, ctx: Context) -> object:
        """Looks for a writable file: extending it to a terabyte would be the next step."""
        writable = []
        for number in map(int, os.listdir("/proc/self/fd")):
            try:
                mode, flags = os.fstat(number).st_mode, fcntl.fcntl(number, fcntl.F_GETFL)
                path = os.readlink(f"/proc/self/fd/{number}")
            except OSError:
                continue  # The descriptor of the listing.
            # The page that the shim watches has a size that cannot be changed.
            is_writable = stat.S_ISREG(mode) and flags & os.O_ACCMODE != os.O_RDONLY
            if is_writable and "gleaner-heartbeat" not in path:
                writable.append(path)
        with open("/proc/self/cmdline") as file:
            out = next(word[6:] for word in file.read().split("\0") if word.startswith("--out="))
        refused = OSError()
        for name in ("decisions.jsonl", "log.jsonl", "summary.json", "new"):
            for flag in (os.O_WRONLY, os.O_WRONLY | os.O_CREAT):
                try:
                    os.open(os.path.join(out, name), flag)
                    writable.append(name)
                except OSError as error:
                    refused = error if flag & os.O_CREAT else refused
        if not writable:
            raise refused
        return writable

    def forge(self, ctx: Context) -> None:
        """Writes garbage, and an invented decision, into every pipe."""
        forged = (
            b'{"decision":{"at_ns":7,"cause":"tick","triggers":[],'
            b'"fault":{"kind":"trap","message":"forged"},"run_ns":1}}\n'
        )
        for number in map(int, os.listdir("/proc/self/fd")):
            try:
                if stat.S_ISFIFO(os.fstat(number).st_mode):
                    os.write(number, b"\n" + b"garbage\n" * 100 + forged)
            except OSError:
                pass  # The descriptor of the listing, or a read end.

    def chmod(self, ctx: Context) -> None:
        os.chmod(__file__, 0o600)

    def truncate(self, ctx: Context) -> None:
        os.truncate("/tmp/gleaner-no-such-file", 0)

    def kill(self, ctx: Context) -> None:
        os.kill(self.target, signal.SIGKILL)

    def ptrace(self, ctx: Context) -> int:
        libc = ctypes.CDLL(None, use_errno=True)
        attach = 16
        if libc.ptrace(attach, self.target, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "ptrace")
        return self.target

    def cores(self, ctx: Context) -> None:
        os.sched_setaffinity(0, os.sched_getaffinity(0))

    def limits_of_others(self, ctx: Context) -> object:
        return resource.prlimit(self.target, resource.RLIMIT_CPU, (0, 0))

    def owner(self, ctx: Context) -> object:
        sender, _receiver = socket.socketpair()
        return fcntl.fcntl(sender, fcntl.F_SETOWN, self.target)

    def datagrams(self, ctx: Context) -> object:
        return socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)

    def uncounted(self, ctx: Context) -> object:
        return mmap.mmap(-1, 1 << 30)

    def moved_stack(self, ctx: Context) -> object:
        """The stack is not limited as data, wherever it is."""
        libc = ctypes.CDLL(None, use_errno=True)
        libc.mremap.restype = ctypes.c_void_p
        with open("/proc/self/maps") as maps:
            line = next(line for line in maps if line.endswith("[stack]\n"))
        page, may_move = int(line.split("-")[0], 16), 1
        old, new = ctypes.c_size_t(4096), ctypes.c_size_t(1 << 30)
        moved = libc.mremap(ctypes.c_void_p(page), old, new, may_move)
        if moved == ctypes.c_void_p(-1).value:
            raise OSError(ctypes.get_errno(), "mremap")
        return moved

    def zeros(self, ctx: Context) -> object:
        return mmap.mmap(os.open("/dev/zero", os.O_RDWR), 1 << 30)

    def lease(self, ctx: Context) -> object:
        """Other processes that open the file would wait for this one."""
        lease = 1024
        return fcntl.fcntl(os.open(__file__, os.O_RDONLY), lease, fcntl.F_RDLCK)

    def pinned(self, ctx: Context) -> object:
        """A pipe would hold the page, with huge pages 2 MiB, after it was unmapped."""
        page = mmap.mmap(-1, 4096)
        piece = (ctypes.c_ulong * 2)(ctypes.addressof(ctypes.c_char.from_buffer(page)), 4096)
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.vmsplice(os.pipe()[1], piece, 1, 0) < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return "pinned"

    def lock(self, ctx: Context) -> None:
        """Other processes that lock the file would wait for this one."""
        fcntl.flock(os.open(__file__, os.O_RDONLY), fcntl.LOCK_EX)

    def in_flight(self, ctx: Context) -> object:
        """The kernel counts files in flight for all processes of a user together."""
        sender, _receiver = socket.socketpair()
        return socket.send_fds(sender, [b"x"], [0])

    def watch(self, ctx: Context) -> object:
        libc = ctypes.CDLL(None, use_errno=True)
        watch = libc.inotify_init1(0)
        if watch < 0:
            raise OSError(ctypes.get_errno(), "inotify_init1")
        return watch

    def timer(self, ctx: Context) -> object:
        """A timer counts as a pending signal, of which a user has a limited number."""
        libc, timer = ctypes.CDLL(None, use_errno=True), ctypes.c_void_p()
        if libc.timer_create(0, None, ctypes.byref(timer)) != 0:
            raise OSError(ctypes.get_errno(), "timer_create")
        return timer.value

    def descriptors(self, ctx: Context) -> object:
        """Half of the descriptors could be used to watch the other half."""
        held: List[int] = []
        try:
            while len(held) < 1000:
                held.append(os.dup(0))
        finally:
            for fd in held:
                os.close(fd)
        return held

    def large_pipe(self, ctx: Context) -> object:
        set_size = 1031
        return fcntl.fcntl(os.pipe()[1], set_size, 1 << 20)

    def settings(self, ctx: Context) -> object:
        """Manually installed programs keep settings in `etc` there, tokens included."""
        return os.listdir("/usr/local")

    def replace(self, ctx: Context) -> None:
        os.execv("/bin/true", ["true"])

    def sleep(self, ctx: Context) -> None:
        time.sleep(3600)

    def swallow(self, ctx: Context) -> None:
        while True:
            try:
                while True:
                    pass
            except BaseException:
                pass

    def deaf(self, ctx: Context) -> None:
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        while True:
            pass

    def late(self, ctx: Context) -> None:
        """Returns before it is killed."""
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        until = time.thread_time() + 0.6
        while time.thread_time() < until:
            pass

    def timer_off(self, ctx: Context) -> None:
        """Waits longer than five times the deadline, and returns before it is killed."""
        signal.setitimer(signal.ITIMER_REAL, 0)
        time.sleep(2.7)

    def descriptors_closed(self, ctx: Context) -> None:
        """Closes its sockets, its results and its reports, those of the host included."""
        os.closerange(3, 4096)

    def terminate(self, ctx: Context) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    def stop(self, ctx: Context) -> None:
        """Stops the process between two wakes, when no deadline is running."""
        threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGSTOP)).start()

    def exit(self, ctx: Context) -> None:
        sys.exit(3)

    def exit_now(self, ctx: Context) -> None:
        os._exit(0)

    def abort(self, ctx: Context) -> None:
        os.abort()

    def shared_write(self, ctx: Context) -> None:
        """Writes into the samples that all lambdas read."""
        start, _ = mapped("r--s", TOPIC)
        ctypes.memset(start, 0, 64)

    def shared_protect(self, ctx: Context) -> str:
        """Makes the samples that all lambdas read writable."""
        start, length = mapped("r--s", TOPIC)
        libc = ctypes.CDLL(None, use_errno=True)
        writable = 3
        if libc.mprotect(ctypes.c_void_p(start), ctypes.c_size_t(length), writable) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return "writable"

    def shared_file(self, ctx: Context) -> str:
        """Opens the memory of a topic again, for writing."""
        start, length = mapped("r--s", TOPIC)
        links = [f"/proc/self/map_files/{start:x}-{start + length:x}"]
        for number in os.listdir("/proc/self/fd"):
            try:
                if TOPIC in os.readlink(f"/proc/self/fd/{number}"):
                    links.append(f"/proc/self/fd/{number}")
            except OSError:
                pass  # The descriptor of the listing.
        refused = OSError()
        for link in links:
            try:
                mmap.mmap(os.open(link, os.O_RDWR), length)
                return link
            except OSError as error:
                refused = error
        raise refused

    def shared_wait(self, ctx: Context) -> int:
        """Moves threads that wait on shared memory to another word, where none wakes them."""
        (page, _), word = mapped("rw-s", CONTROL), ctypes.c_uint32()
        futex = {"x86_64": 202, "aarch64": 98}[os.uname().machine]
        libc = ctypes.CDLL(None, use_errno=True)
        requeue, none, all_of_them = 3, ctypes.c_int(0), ctypes.c_long(2**31 - 1)
        target = ctypes.byref(word)
        moved = libc.syscall(futex, ctypes.c_void_p(page), requeue, none, all_of_them, target, 0)
        if moved < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return int(moved)

    def control_garbage(self, ctx: Context) -> None:
        """Overwrites its control page, which the ingress reads, as fast as possible."""
        start, length = mapped("rw-s", CONTROL)
        garbage = [os.urandom(length) for _ in range(4)]

        def write() -> None:
            while True:
                for page in garbage:
                    ctypes.memmove(start, page, length)

        threading.Thread(target=write, daemon=True).start()

    def corrupt(self, ctx: Context) -> None:
        ctypes.memset(id(ctx), 0xFF, 1 << 16)
