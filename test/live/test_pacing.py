"""When a setpoint is due: by the table's time, by the steady clock, and at once where it is new."""

from __future__ import annotations

from imu_calib.live.sequencer import Pacing

MS = 1_000_000


def test_a_new_setpoint_is_due_at_once_and_once() -> None:
    pacing = Pacing(10.0)
    pacing.sent(0, 0.0, 1)
    assert not pacing.is_due(50 * MS, 0.05, 1)
    assert pacing.is_due(50 * MS, 0.05, 2)
    pacing.sent(50 * MS, 0.05, 2)
    assert not pacing.is_due(60 * MS, 0.06, 2)


def test_without_joint_states_the_steady_clock_counts() -> None:
    pacing = Pacing(10.0)
    assert pacing.is_due(None, 5.0, 1)
    pacing.sent(None, 5.0, 1)
    assert not pacing.is_due(None, 5.099, 1)
    assert pacing.is_due(None, 5.101, 1)
    # Joint states that stand still are no time either.
    pacing.sent(0, 6.0, 1)
    assert not pacing.is_due(0, 6.099, 1)
    assert pacing.is_due(0, 6.101, 1)


def test_a_fast_table_is_led_by_its_own_time() -> None:
    pacing, stamps = Pacing(10.0), []
    for k in range(1000):
        stamp = k * 10 * MS
        if pacing.is_due(stamp, 1e-5 * k, 1):
            pacing.sent(stamp, 1e-5 * k, 1)
            stamps.append(stamp)
    assert stamps == [k * 100 * MS for k in range(100)]


def test_a_delay_does_not_lower_the_rate() -> None:
    """Joint states every 30 ms, setpoints every 100 ms: ten in a second in the mean."""
    pacing, count = Pacing(10.0), 0
    for k in range(1000):
        if pacing.is_due(k * 30 * MS, 1e-6 * k, 0):
            pacing.sent(k * 30 * MS, 1e-6 * k, 0)
            count += 1
    assert abs(count - 300) <= 1


def test_a_table_whose_time_begins_anew_is_led_on() -> None:
    pacing = Pacing(10.0)
    pacing.sent(10_000 * MS, 0.0, 1)
    assert not pacing.is_due(10_050 * MS, 0.01, 1)
    assert pacing.is_due(0, 0.02, 1)
    pacing.sent(0, 0.02, 1)
    assert not pacing.is_due(50 * MS, 0.03, 1)
    assert pacing.is_due(100 * MS, 0.04, 1)
