"""Tests of the lambda on synthetic drives. Run them with: python -m pytest"""

from __future__ import annotations

from gleaner.testing import Run, replay

from main import Lambda


def drive(forward_mps2: list[float]) -> Run:
    """Replays forward accelerations in m/s² at 100 Hz."""
    seconds = [n / 100 for n in range(len(forward_mps2))]
    run = replay(Lambda, {"/imu/data": {"t": seconds, "linear_acceleration.x": forward_mps2}})
    assert not run.faults
    return run


def test_hard_braking_triggers_once() -> None:
    run = drive([0.0] * 100 + [-5.0] * 100 + [0.0] * 100)
    assert [trigger.label for trigger in run.triggers] == ["hard-brake"]
    assert 1.0 < run.triggers[0].at_s < 2.0


def test_a_tap_on_the_brake_does_not_trigger() -> None:
    assert drive([0.0] * 100 + [-5.0] * 10 + [0.0] * 100).triggers == []
