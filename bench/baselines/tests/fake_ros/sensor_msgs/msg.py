from types import SimpleNamespace


class Imu:
    pass


class Image:
    pass


class TimeReference:
    def __init__(self) -> None:
        self.header = SimpleNamespace(stamp=None)
        self.time_ref = SimpleNamespace(sec=0, nanosec=0)
        self.source = ""
