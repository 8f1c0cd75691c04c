"""Run a plan on a turntable: joint states and commands in, setpoints and the state out."""

from .encoders import Encoders, Feedback, FeedbackError
from .rules import Phase, Rules, SequencerState
from .sequencer import Sequencer
from .trajectory import Lead, Overtaken
from .watch import SETS_OUT

__all__ = [
    'SETS_OUT',
    'Encoders',
    'Feedback',
    'FeedbackError',
    'Lead',
    'Overtaken',
    'Phase',
    'Rules',
    'Sequencer',
    'SequencerState',
]
