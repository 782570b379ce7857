"""Hashes the pixels of every frame (FNV-1a, 32 bits, rows without padding) as a label."""

from gleaner import Context, Sample


def on_event(ctx: Context, event: Sample) -> None:
    ctx.event(f"{fnv1a(event.as_frame().array().tobytes()):08x}", 0.0)


def fnv1a(data: bytes) -> int:
    value = 0x811C9DC5
    for byte in data:
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return value
