from types import SimpleNamespace

SignalHandlerOptions = SimpleNamespace(NO=0)
