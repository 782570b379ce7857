"""Tests the lambda locally, without the runtime. `pip install ./guest-sdk-python pytest`, then
`pytest examples/imu-fft`.

Drives that cannot be distributed with the project are in the folder that `GLEANER_SHARED` names;
tests that need a missing one are skipped."""

from __future__ import annotations

import csv
import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gleaner.testing import Run, Trigger, replay

EXAMPLES = Path(__file__).resolve().parents[2]
PYTHON = EXAMPLES / "imu-fft" / "python"
SAMPLE = EXAMPLES / "data" / "highway_drive.mcap"

sys.path.append(str(EXAMPLES))
from shared_data import shared  # noqa: E402

ALL = {"rough": 0.0}


def shaken(signal: Any, rate_hz: float = 50.0, keep: Any = None, **config: Any) -> Run:
    """Replays vertical accelerations, of which only those at the indices `keep` arrive."""
    keep = np.arange(len(signal)) if keep is None else np.asarray(keep)
    table = {"t": keep / rate_hz, "linear_acceleration.z": np.asarray(signal)[keep]}
    run = replay(PYTHON, {"/imu/data": table}, config={**ALL, **config})
    assert not run.faults
    return run


def sine(hz: float, amplitude: float, n: int = 200, rate_hz: float = 50.0) -> Any:
    return 9.81 + amplitude * np.sin(2 * np.pi * hz * np.arange(n) / rate_hz)


def ends(run: Run, rate_hz: float = 50.0) -> list[int]:
    """Returns the index of the last sample of each window."""
    return [round(trigger.at_s * rate_hz) for trigger in run.triggers]


# Bins of 256 samples at 50 Hz are 0.1953125 Hz apart; each frequency is at a bin, whose neighbours
# are in the same band.
@pytest.mark.parametrize(
    ("hz", "weight"), [(1.171875, 0.2), (4.6875, 0.5), (12.5, 1.0), (23.4375, 0.0)]
)
def test_a_sine_scores_its_mean_square_by_the_weight_of_its_band(hz: float, weight: float) -> None:
    # The second sine only keeps the score above 0.
    run = shaken(sine(hz, amplitude=3.0, n=600) + sine(12.5, amplitude=1e-3, n=600), window_s=5.0)
    assert ends(run) == [255, 319, 383, 447, 511, 575]
    assert [trigger.score for trigger in run.triggers] == pytest.approx(
        [weight * 4.5] * 6, abs=0.01
    )
    if weight in (0.2, 0.5):
        assert [trigger.attributes["peak_hz"] for trigger in run.triggers] == pytest.approx(
            [hz] * 6
        )


def test_a_window_is_complete_every_quarter_of_its_length() -> None:
    run = shaken(sine(5.0, 1.0, n=130))
    assert ends(run) == [63, 79, 95, 111, 127]


def test_no_window_includes_a_gap() -> None:
    # Two samples are missing: 3 periods. The next run begins with sample 102.
    whole = np.arange(300)
    run = shaken(sine(5.0, 1.0, n=300), keep=np.delete(whole, [100, 101]))
    assert ends(run) == [63, 79, 95, *range(102 + 63, 300, 16)]
    # One missing sample is not a gap: samples are counted, not time.
    run = shaken(sine(5.0, 1.0, n=300), keep=np.delete(whole, [100]))
    assert ends(run) == [63, 79, 95, *range(112, 300, 16)]


def test_a_gap_while_the_period_is_learnt_starts_a_new_run() -> None:
    run = shaken(sine(5.0, 1.0, n=200), keep=np.delete(np.arange(200), range(10, 20)))
    assert ends(run) == list(range(20 + 63, 200, 16))


def test_a_stamp_that_does_not_increase_starts_again() -> None:
    for at in (5, 100):
        twice = np.sort(np.append(np.arange(200), at))
        run = shaken(sine(5.0, 1.0, n=200), keep=twice)
        begun = [63, 79, 95] if at == 100 else []
        assert ends(run) == begun + list(range(at + 63, 200, 16))


@pytest.mark.parametrize(
    ("rate_hz", "window_s", "n"), [(50, 1.25, 64), (104, 1.25, 128), (197.5, 5.2, 1024)]
)
def test_the_length_of_a_window_is_a_power_of_two(rate_hz: float, window_s: float, n: int) -> None:
    run = shaken(sine(5.0, 1.0, 2 * n, rate_hz), rate_hz, window_s=window_s)
    assert ends(run, rate_hz) == [n - 1 + hop * n // 4 for hop in range(5)]


def test_of_two_equally_near_lengths_the_larger_one_is_used() -> None:
    samples = lambda_file().samples
    lengths = [samples(wanted) for wanted in (0.0, 23.9, 24.0, 47.9, 48.0, 1e9)]
    assert lengths == [16, 16, 32, 32, 64, 4096]


def test_nan_is_not_rough() -> None:
    assert shaken(np.full(200, np.nan)).triggers == []


@pytest.mark.parametrize("constant", [9.81, 9.7])
def test_a_constant_scores_exactly_zero(constant: float) -> None:
    run = shaken(np.full(200, constant))
    assert (run.counts["imu"].received, run.triggers) == (200, [])


def test_the_sample_drive_has_two_rough_stretches() -> None:
    seconds = [trigger.at_s for trigger in replay(PYTHON, SAMPLE).triggers]
    assert seconds == pytest.approx([14.72, 15.03, 18.71, 19.02, 19.33, 19.63], abs=0.01)


def test_regular_roads_score_lower_than_others() -> None:
    with shared("road_surface/accz_50hz_labelled.csv").open(encoding="utf-8") as file:
        series = [
            (row["label"], row["acc_z_mps2_semicolon_separated"].split(";"))
            for row in csv.DictReader(file)
        ]
    runs = [(label, shaken([float(z) for z in values])) for label, values in series]
    scored = [(label, max(trigger.score or 0.0 for trigger in run.triggers)) for label, run in runs]
    regular = np.array([score for label, score in scored if label == "regular_road"])
    others = np.array([score for label, score in scored if label != "regular_road"])
    assert (len(regular), len(others)) == (60, 240)
    area = np.mean(others[:, None] > regular[None, :])
    assert area >= 0.80


def test_scores_correlate_with_the_noise_of_the_wheels() -> None:
    run = replay(PYTHON, shared("rec_highway_imu_can_00_30s.mcap"), config=ALL)
    text = shared("rec_highway_imu_can_00_30s.truth.json").read_text(encoding="utf-8")
    truth = json.loads(text)["windows"]
    wheels = [window["wheel_speed_rms_hp5hz"] for window in truth]
    scores = [nearest(run.triggers, window["end_s"]).score for window in truth]
    assert len(truth) > 50
    assert np.corrcoef(ranks(scores), ranks(wheels))[0, 1] >= 0.7


def test_the_peak_of_a_walk_is_the_frequency_of_its_steps() -> None:
    run = replay(PYTHON, shared("rec_sync_gopro_walk.mcap"), config={**ALL, "window_s": 5.2})
    assert [trigger.attributes["peak_hz"] for trigger in run.triggers] == pytest.approx(
        [1.74] * len(run.triggers), abs=0.1
    )
    assert len(run.triggers) >= 4


def nearest(triggers: list[Trigger], at_s: float) -> Trigger:
    """Returns the window that ends nearest to an instant."""
    return min(triggers, key=lambda trigger: abs(trigger.at_s - at_s))


def ranks(values: Any) -> Any:
    return np.argsort(np.argsort(values))


def lambda_file() -> Any:
    """Returns the file of the lambda as a module."""
    spec = importlib.util.spec_from_file_location("imu_fft", PYTHON / "main.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
