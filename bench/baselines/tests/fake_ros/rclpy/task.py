import threading


class Future:
    def __init__(self) -> None:
        self.done = threading.Event()

    def set_result(self, result: None) -> None:
        self.done.set()
