"""Results as a benchmark writes them, with values that are drawn with fixed seeds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

# Sides of round trips: the median in ms, its spread, CPU in %, memory in MB.
SIDES: dict[str, tuple[float, float, float, float]] = {
    "bare reader": (0.112, 0.35, 1.9, 9.0),
    "native Rust": (0.125, 0.35, 2.0, 10.0),
    "lambda, wasm": (0.165, 0.45, 2.7, 23.0),
    "lambda, wasm without checks": (0.158, 0.45, 2.6, 23.0),
    "lambda, Python": (0.214, 0.5, 3.3, 52.0),
    "stand-in (Cyclone DDS for Python)": (0.223, 0.45, 3.2, 54.0),
    "rclpy": (0.348, 0.4, 5.8, 66.0),
    "rclpy, memory kept": (0.366, 0.42, 5.8, 68.0),
}
HOSTILE = "a|b <x> & _%"


def series(name: str, values: Any, **more: Any) -> dict[str, Any]:
    values = [float(value) for value in values]
    empty: dict[str, Any] = {"details": {}, "reception": None, "turns": [], "costs": {},
                             "invalid": []}
    return {"name": name, "values": values, **empty, **more}


def group(name: str, bases: list[str], *all_series: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "unit": "ms", "bases": bases, "series": list(all_series)}


def results(**more: Any) -> dict[str, Any]:
    facts = {"processor": "AMD EPYC <x>", "kernel": "6.18.44", "measured": "2026-12-01 00:10 UTC"}
    empty: dict[str, Any] = {"figures": [], "groups": [], "growths": [], "notes": []}
    return {"format": 2, "bench": "rtt", "is_quick": False, "is_complete": True,
            "machine": {"facts": facts}, **empty, **more}


def rtt(seed: int = 1, count: int = 6000, is_quick: bool = False) -> dict[str, Any]:
    """Round trips of eight sides in three turns, with costs, growths, and one invalid side."""
    random = np.random.RandomState(seed)

    def side(name: str, factor: float) -> dict[str, Any]:
        median, sigma, cpu, memory = SIDES[name]
        # The noise of neighbours is alike, and few values are late.
        noise = np.convolve(random.normal(size=count + 4), np.ones(5) / 5**0.5, "valid")
        late = random.choice([1, 4], count, p=[0.99, 0.01])
        values = factor * median * np.exp(sigma * noise) * late
        turn = 1 + 0.02 * random.normal(size=3)
        costs = {"CPU, % of a core": cpu * turn, "memory (PSS), MB": memory * turn,
                 "power above idle, VDD_IN, W": 0.11 * cpu * turn,
                 "energy per wake above idle, VDD_IN, mJ": 1.1 * cpu * turn}
        return series(name, values, reception={"sent": count + 1, "answered": count},
                      turns=[count // 3, count // 3, count - 2 * (count // 3)],
                      details={"stack": "RustDDS <1>", "socket buffer, B": "425984"},
                      costs={key: list(cost) for key, cost in costs.items()})

    names = ["IMU at 100 Hz, empty, socket buffers of 4 MiB",
             "IMU at 100 Hz, a spectrum in each wake, socket buffers of 4 MiB",
             "raw images of 1080p at 10 Hz, luma > 127 & brake, socket buffers of 64 MiB"]
    groups = [group(name, ["rclpy", "stand-in (Cyclone DDS for Python)", "bare reader"],
                    *(side(one, factor) for one in SIDES))
              for name, factor in zip(names, (1.0, 1.4, 25.0))]
    groups[1]["series"][2]["invalid"] = ["turn 2: the processor was throttled 3 times"]
    groups[2]["series"] = groups[2]["series"][:4]
    for one in groups[2]["series"]:
        one["values"], one["turns"] = one["values"][:40], []
    few = group("few values", ["rclpy"], series("rclpy", [1.0]), series("lambda, wasm", []),
                series(HOSTILE, [1.0, 2.0, 2.5]))
    growths = [{"name": f"{names[0]}: memory (PSS) in the last turn", "of": "seconds", "unit": "MB",
                "curves": [{"name": name, "points": [[4.0 * at, SIDES[name][3] + 0.1 * at]
                                                     for at in range(6)]} for name in SIDES]}]
    figures = [{"name": "wake, p50", "unit": "us", "goal": {"at_most": 20.0},
                "values": [18.0, 19.0]},
               {"name": "lost samples", "unit": "", "goal": {"at_most": 0.0}, "values": [None]},
               {"name": "rate", "unit": "wakes/s", "goal": None, "values": [269744.3]}]
    notes = ["Each side starts again for each turn. *Answered of sent* includes the warm-up."]
    return results(is_quick=is_quick, groups=[*groups, few], growths=growths, figures=figures,
                   notes=notes)


def store(folder: Path, content: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(content))
    return folder
