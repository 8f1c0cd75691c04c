"""Texts of turntable_node on a sequencer's state for /diagnostics."""

from __future__ import annotations

from ...common.units import DEG
from ..rules import Phase, SequencerState


def state_sentence(state: SequencerState) -> str:
    """Return a sentence on the state; it changes only with step and phase."""
    if state.waits_for:
        return f'Waits for {state.waits_for}.'
    if state.reason:
        return state.reason
    if state.phase in {Phase.IDLE, Phase.DONE}:
        return {Phase.IDLE: 'Nothing is started.', Phase.DONE: 'The plan is done.'}[state.phase]
    where = f'position {state.position}' if state.position else 'back to the start'
    return f'{state.phase.name.capitalize()}: step {state.step + 1} of {state.steps}, {where}.'


def state_figures(state: SequencerState, joints: tuple[str, ...]) -> dict[str, str]:
    """Return figures of a state for a person, with units."""
    described = {
        'plan': state.plan,
        'phase': state.phase.name,
        'step': f'{state.step + 1} of {state.steps}' if state.steps else 'none',
        'position': state.position or 'none',
        'time left': f'{state.seconds_left:.0f} s',
    }
    for name, angle, rate in zip(joints, state.angles, state.rates, strict=False):
        described[f'joint {name}'] = f'{angle / DEG:.4f} deg, {rate / DEG:.3f} deg/s'
    return described
