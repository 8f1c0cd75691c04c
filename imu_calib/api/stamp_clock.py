"""Sentences on header stamps that contradict the recorder's clock, and what contains the error."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..common.errors import InputError, NotObservable
from ..common.stream import Units
from ..common.units import PPM
from ..recordings.rosbag2 import Recording

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..recordings.recorded_clock import RecordedClock
    from .streams import Streams


# Loads slowly; most commands do not need it.

_DIFFERENT = 1000 * PPM
"""From which two clocks differ by more than clocks do: quartz is off by 20 to 100 ppm, and a daemon
of NTP slews a clock by 500 ppm at most (RFC 5905, appendix A.5.5.6)."""
_SURELY = 3.0
"""Standard deviations beyond that."""
_ANOTHER_PACE = 0.1
"""From which two clocks are not of one kind: simulated time, or a recording that was played at
another rate. IMUs with oscillators of their own are off by some per cent."""
_UNIT = 0.2
"""Relative difference from a power of a thousand at which the unit is wrong. A judgement."""
_POWERS = {1: 'a thousand', 2: 'a million', 3: 'a billion'}


@contextmanager
def refused_by_stamps(recording: Recording, streams: Streams) -> Iterator[None]:
    """Refuse stamps without a unit or a value where the session is refused for anything else.

    Only there: time that is simulated may pass a thousand times as fast as the recorder's.

    Raises:
        InputError: The stamps of a topic that was read are all equal, or in another unit.
    """
    try:
        yield
    except (InputError, NotObservable):
        for topic in (streams.imu, streams.joints):
            if topic is not None and (sentence := contradiction(recording, topic)):
                raise InputError(f'{recording.path}: {topic}: {sentence}') from None
        raise


def contradiction(recording: Recording, topic: str) -> str:
    """Return why the stamps of a topic cannot be times; empty if they can."""
    clock = recording.clocks.get(topic)
    if clock is None or clock.stamps is None or clock.log is None or clock.stamps.count < 2:
        return ''
    stamps, log = clock.stamps, clock.log
    if stamps.first == stamps.last:
        value = '0' if stamps.first == 0 else f'{stamps.first * 1e-9:.9f} s'
        return (
            f'all {stamps.count} header stamps are {value}: when the samples were taken '
            'is not recorded. Let the driver stamp each message, and record again.'
        )
    ratio = clock.ratio()
    power = 0 if ratio is None else round(math.log10(ratio.value) / 3)
    if ratio is None or abs(power) not in _POWERS or abs(ratio.value / 1e3**power - 1) > _UNIT:
        return ''
    times = f'{_POWERS[abs(power)]} times too {"long" if power > 0 else "short"}'
    return (
        f'the header stamps last {stamps.seconds:.4g} s where the recorder counted '
        f'{log.seconds:.4g} s, {times}: the driver confuses units of time (s, ms, us, ns). Correct '
        'it, and record again.'
    )


def clock_findings(recording: Recording, streams: Streams, units: Units) -> list[str]:
    """Return a sentence on the clock by which a calibration counts seconds, if it is off.

    Args:
        recording: Read.
        streams: Its topics: seconds are those of joint states, without these those of the IMU.
        units: Of the IMU.
    """
    topic = streams.imu if streams.joints is None else streams.joints
    # docs/mathematics.md, 'Uncertainty budget': pulses per angle do not depend on a clock.
    return _differing(recording, topic, 'every K_a' if units.per_interval else 'every K_g')


def sample_findings(recording: Recording, topic: str, units: Units) -> list[str]:
    """Return a sentence on stamps of samples that are compensated, if these cannot be right.

    Args:
        recording: Of which the topic was read last.
        topic: The raw stream.
        units: Of its samples.
    """
    if sentence := contradiction(recording, topic):
        return [f'{topic}: {sentence}']
    # Increments become rates by the interval of the stamps.
    rates = 'every rate and force'
    containing = rates if units.per_interval else 'what is integrated over the stamps'
    return _differing(recording, topic, containing)


def average_findings(recording: Recording, topic: str) -> list[str]:
    """Return a sentence on the clock by which averaging times are counted, if it is off."""
    return _differing(recording, topic, 'every averaging time')


def _differing(recording: Recording, topic: str, containing: str) -> list[str]:
    """Return a sentence on stamps that run fast or slow, and on what contains that."""
    clock = recording.clocks.get(topic)
    if clock is None or not (said := difference(clock)):
        return []
    return [
        f'The header stamps of {topic} run {said}, more than clocks differ ({_DIFFERENT / PPM:g} '
        f"ppm): {containing} contains this difference, unless the recorder's clock is wrong. Let "
        'the driver stamp by a right clock, not by a nominal interval, and record again.'
    ]


def difference(clock: RecordedClock) -> str:
    """Return by how much stamps run fast or slow, in words; empty if that is usual or unknown."""
    ratio = clock.ratio()
    if ratio is None:
        return ''
    faster = abs(ratio.value - 1)
    if not _DIFFERENT + _SURELY * ratio.std < faster < _ANOTHER_PACE:
        return ''
    return (
        f'{faster * 100:.3g} % ({faster / PPM:.0f} +- {max(ratio.std / PPM, 1):.0f} ppm) too '
        f"{'fast' if ratio.value > 1 else 'slow'} against the recorder's log times"
    )

    # Loaded only if it is stated how the streams are to be read.
