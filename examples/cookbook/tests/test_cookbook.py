"""Tests the Python recipes locally, without the runtime. `pip install ./guest-sdk-python pytest`,
then `pytest examples/cookbook`.

`tests/tests/programs/cookbook.rs` runs all ten recipes in the real host."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gleaner.testing import Run, StartError, replay

COOKBOOK = Path(__file__).resolve().parents[1]
SAMPLE = COOKBOOK.parent / "data" / "highway_drive.mcap"
RECIPES = sorted(path.parent.name for path in COOKBOOK.glob("*/main.py"))

sys.path.append(str(COOKBOOK.parent))
from shared_data import shared  # noqa: E402

IMU = "/imu/data"
SPEED = "/vehicle/speed"


def run(name: str, drive: Any, **config: Any) -> Run:
    done = replay(COOKBOOK / name, drive, config=config)
    assert not done.faults
    return done


def times(done: Run) -> list[float]:
    return [round(trigger.at_s, 2) for trigger in done.triggers]


def hundredths(seconds: float) -> Any:
    return np.arange(round(seconds * 100)) / 100


@pytest.mark.parametrize("name", RECIPES)
def test_a_local_run_of_a_recipe_agrees_with_expected_txt(name: str) -> None:
    command, *rows = (COOKBOOK / name / "expected.txt").read_text(encoding="utf-8").splitlines()
    settings = [word.split("=") for word in command.split() if "=" in word]
    done = run(name, SAMPLE, **{key: float(value) for key, value in settings})
    found = [(f"{trigger.at_s:.3f}", trigger.label) for trigger in done.triggers]
    assert found == [tuple(row.split()[:2]) for row in rows]


def test_four_lane_changes_are_four_swerves() -> None:
    # The two hard ones to the right are labelled in the data set, at 16.1 to 18.5 s and 25.1 to
    # 27.6 s.
    drive = shared("rec_brake_imu_trip17.mcap")
    assert times(run("swerve", drive)) == pytest.approx([13.13, 17.12, 22.2, 26.25], abs=0.02)


def test_sides_too_far_apart_are_not_a_swerve() -> None:
    t = hundredths(12)
    y = np.where((t > 2) & (t < 3), 4.0, 0.0) - np.where((t > 7) & (t < 8), 4.0, 0.0)
    assert times(run("swerve", {IMU: {"t": t, "linear_acceleration.y": y}})) == []
    drive = {IMU: {"t": t, "linear_acceleration.y": y}}
    assert len(times(run("swerve", drive, within_s=10.0))) == 1


def test_nan_in_a_bend_is_not_a_swerve() -> None:
    t = hundredths(12)
    y = np.where((t > 2) & (t < 6), 4.0, 0.0)
    y[400] = np.nan
    assert times(run("swerve", {IMU: {"t": t, "linear_acceleration.y": y}})) == []


def test_a_swerve_is_found_at_nine_samples_a_second() -> None:
    t = np.arange(110) * 0.11
    y = np.where((t > 2) & (t < 3), 4.0, 0.0) - np.where((t > 3) & (t < 4), 4.0, 0.0)
    assert len(times(run("swerve", {IMU: {"t": t, "linear_acceleration.y": y}}))) == 1


def test_a_car_that_creeps_between_the_thresholds_stays_stopped() -> None:
    t = hundredths(30)
    v = np.select([t < 5, t < 10, t < 20], [10.0, 0.0, 1.5], 10.0)
    done = run("stopped", {SPEED: {"t": t, "twist.linear.x": v}})
    assert [(trigger.kind, round(trigger.at_s, 1)) for trigger in done.triggers] == [
        ("start", 8.0),
        ("stop", 20.0),
    ]


def test_nan_is_not_standing() -> None:
    t = hundredths(10)
    assert run("stopped", {SPEED: {"t": t, "twist.linear.x": np.nan * t}}).triggers == []


def test_a_recording_ends_also_after_a_fault_in_it(tmp_path: Path) -> None:
    for name in ("lambda.toml", "main.py"):
        (tmp_path / name).write_text(
            (COOKBOOK / "stopped" / name).read_text(encoding="utf-8"), encoding="utf-8"
        )
    with (tmp_path / "main.py").open("a", encoding="utf-8") as main:
        main.write(FAULT_AT_A_QUARTER)
    t = hundredths(20)
    v = np.select([t < 5, t == 10, t < 15], [10.0, 0.25, 0.0], 10.0)
    done = replay(tmp_path, {SPEED: {"t": t, "twist.linear.x": v}})
    assert len(done.faults) == 1
    assert [(trigger.kind, round(trigger.at_s, 1)) for trigger in done.triggers] == [
        ("start", 8.0),
        ("stop", 15.0),
    ]


# Appended to a recipe: a fault at a speed of 0.25 m/s.
FAULT_AT_A_QUARTER = """
class Lambda(Lambda):
    def on_event(self, ctx, event):
        if event.number(self.speed) == 0.25:
            raise ValueError("a fault")
        super().on_event(ctx, event)
"""


def test_thresholds_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(StartError) as refused:
        run("stopped", SAMPLE, stopped_mps=5.0)
    assert "going_mps is 2.0; it must be above stopped_mps" in str(refused.value.__cause__)


def test_an_imu_that_is_not_level_is_not_a_mismatch() -> None:
    t = hundredths(30)
    v = 10 + 0.5 * t
    level = {
        IMU: {"t": t, "linear_acceleration.x": 0.5 + 0 * t},
        SPEED: {"t": t, "twist.linear.x": v},
    }
    tilted = {**level, IMU: {"t": t, "linear_acceleration.x": 1.6 + 0 * t}}
    assert (times(run("speed-mismatch", level)), times(run("speed-mismatch", tilted))) == ([], [])
    slips = {
        **tilted,
        SPEED: {"t": t, "twist.linear.x": v + np.where((t > 20) & (t < 22), 8.0, 0.0)},
    }
    assert times(run("speed-mismatch", slips))[0] == pytest.approx(20.1, abs=0.15)


def test_a_mismatch_is_found_at_ten_samples_a_second_and_after_nan() -> None:
    t = np.arange(300) / 10 + 0.03 * (np.arange(300) % 2)
    x = 1.6 + 0 * t
    x[:3] = np.nan
    steady = {
        IMU: {"t": t, "linear_acceleration.x": x},
        SPEED: {"t": t, "twist.linear.x": 10 + 0.5 * t},
    }
    assert times(run("speed-mismatch", steady)) == []
    slips = {
        **steady,
        SPEED: {"t": t, "twist.linear.x": 10 + 0.5 * t + np.where((t > 20) & (t < 22), 8.0, 0.0)},
    }
    assert times(run("speed-mismatch", slips))[0] == pytest.approx(20.1, abs=0.15)


def test_a_sensor_that_never_sent_is_silent() -> None:
    t = hundredths(12)
    done = run("sensor-silent", {IMU: {"t": t}, SPEED: {"t": t}})
    assert [trigger.attributes["topic"] for trigger in done.triggers] == [
        "/camera/front/compressed"
    ]
    assert times(done) == pytest.approx([10.0], abs=0.2)


def test_a_sensor_that_is_discovered_late_is_not_silent() -> None:
    t = hundredths(12)
    assert times(run("sensor-silent", {IMU: {"t": t}, SPEED: {"t": t[500:]}}, first_s=20.0)) == []


def test_an_image_is_new_once_and_the_oldest_kind_is_forgotten(tmp_path: Path) -> None:
    manifest = tmp_path / "lambda.toml"
    text = (COOKBOOK / "novelty" / "lambda.toml").read_text(encoding="utf-8")
    manifest.write_text(text.replace("CompressedImage", "Image"), encoding="utf-8")

    def new(greys: list[int]) -> list[float]:
        images = [np.full((36, 64), grey, np.uint8) for grey in greys]
        table = {"t": np.arange(len(greys)), "image": images}
        return times(
            replay(COOKBOOK / "novelty", {"/camera/front/compressed": table}, manifest=manifest)
        )

    assert new([10, 200, 10, 200, 10]) == [1]
    # 17 kinds are one more than it keeps: the first is forgotten.
    kinds = [8 * index for index in range(17)]
    assert new(kinds + kinds[1:] + kinds[:1]) == [*range(1, 17), 33]
