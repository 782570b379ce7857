"""`[limits]`: key, unit, and minimum, default and maximum; sizes in bytes, durations in ns.

Made by `cargo xtask bless` of the table in `lambda/src/manifest/limits.rs`."""

from typing import Tuple

LIMITS: Tuple[Tuple[str, str, Tuple[int, int, int]], ...] = (
    ("fuel", "number", (1_000, 50_000_000, 1_000_000_000_000)),
    ("init_fuel", "number", (1_000, 1_000_000_000, 1_000_000_000_000)),
    ("deadline", "duration", (1_000_000, 50_000_000, 60_000_000_000)),
    ("init_deadline", "duration", (1_000_000, 10_000_000_000, 300_000_000_000)),
    ("model_time", "duration", (1_000_000, 1_000_000_000, 60_000_000_000)),
    ("memory", "size", (1_048_576, 67_108_864, 1_073_741_824)),
    ("tables", "number", (1, 20_000, 1_000_000)),
    ("stack", "size", (16_384, 524_288, 524_288)),
    ("handles", "number", (16, 4_096, 65_536)),
    ("frames", "number", (1, 256, 4_096)),
    ("call_bytes", "size", (65_536, 1_048_576, 1_048_576)),
    ("call_items", "number", (16, 65_536, 65_536)),
    ("scratch", "size", (0, 0, 268_435_456)),
    ("log_lines", "number", (1, 100, 10_000)),
    ("log_bytes", "size", (4_096, 409_600, 16_777_216)),
    ("events_per_minute", "number", (1, 12_000, 60_000)),
)
