"""The lambda without any vehicle. Run with: python -m pytest"""

from __future__ import annotations

from gleaner.testing import Run, replay

from main import Lambda


def drive(forward_mps2: list[float]) -> Run:
    """What it makes of forward accelerations at 100 Hz."""
    seconds = [n / 100 for n in range(len(forward_mps2))]
    run = replay(Lambda, {"/imu/data": {"t": seconds, "linear_acceleration.x": forward_mps2}})
    assert not run.faults
    return run


def test_hard_braking_is_found_once() -> None:
    run = drive([0.0] * 100 + [-5.0] * 100 + [0.0] * 100)
    assert [trigger.label for trigger in run.triggers] == ["hard-brake"]
    assert 1.0 < run.triggers[0].at_s < 2.0


def test_a_tap_on_the_brake_is_none() -> None:
    assert drive([0.0] * 100 + [-5.0] * 10 + [0.0] * 100).triggers == []
