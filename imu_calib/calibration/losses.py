"""Sentences on unused data of a session and on missing steps of its plan."""

from __future__ import annotations

from ..common.errors import ImuCalibError
from ..estimation.checks import Solution
from ..estimation.evidence import Evidence
from ..estimation.methods import Setup
from ..segmentation.labelling import Labelled
from ..segmentation.stream_facts import Segmented


def losses_of_all_segments(session: Segmented, labelled: Labelled, setup: Setup) -> str:
    """Return sentences that no dwell or whole turn was found, and why."""
    if not session.samples:
        return 'The IMU stream is empty: nothing can be determined.'
    if not session.duration:
        losses = ' '.join(f'{loss}.' for loss in session.losses)
        return f'None of {session.samples} IMU samples can be used. {losses}'
    looked_for = 'Neither a static dwell nor a whole turn'
    if setup.plan.is_stated:
        looked_for = f'None of the positions of plan {setup.plan.name}'
    text = (
        f'{looked_for} was found in {session.samples} IMU samples ({session.duration:.0f} s): '
        'nothing can be determined.'
    )
    reasons = sorted({r.reason for r in labelled.rejected})
    loose = len(session.segments)
    if loose and setup.plan.is_stated:
        text += f' {loose} static dwells fit no position of the plan.'
    sentences = [*(f'Left out: {reason}' for reason in reasons[:3]), *session.losses]
    return ' '.join([text, *(f'{sentence}.' for sentence in sentences)])


def false_samples_first(error: ImuCalibError, session: Segmented) -> ImuCalibError:
    """Return a refusal that names false samples first, if there are many: they may explain it."""
    found = session.false_samples
    if not found.is_large:
        return error
    (sentence,) = found.sentences
    others = str(error).replace(f'{sentence}.', '').strip()
    return type(error)(f'{sentence}. {others}')


def loss_findings(
    setup: Setup, evidence: Evidence, labelled: Labelled, session: Segmented
) -> list[str]:
    """Return sentences on data not used or outside the plan, and on missing steps of the plan."""
    sentences = []
    missing = evidence.missing_positions()
    if missing:
        sentences.append(f'Missing from the recording: position {", ".join(missing)}.')
    if setup.plan.is_stated:
        sentences += _beside_plan(setup, labelled)
    found = {segment.position for segment in labelled.segments}
    alike: dict[tuple[bool, bool, str], list[str]] = {}
    for rejected in labelled.rejected:
        again = '; it was measured again' if rejected.position in found else ''
        reason = rejected.reason + ('' if rejected.turn else again)
        at = f'{(rejected.start - (session.start or 0)) * 1e-9:.0f} s'
        known = rejected.position is not None
        alike.setdefault((known, rejected.turn, reason), []).append(rejected.position or at)
    for (known, turn, reason), names in alike.items():
        what = 'a turn is left out' if turn else 'left out'
        place = 'Position' if known else 'At'
        sentences.append(f'{place} {", ".join(dict.fromkeys(names))}: {what}, {reason}.')
    sentences += [
        f'Position {segment.position}: {note}.'
        for segment in labelled.segments
        for note in segment.notes
    ]
    sentences += [f'{loss}.' for loss in (*labelled.notes, *session.losses)]
    return list(dict.fromkeys(sentences))


def _beside_plan(setup: Setup, labelled: Labelled) -> list[str]:
    """Return sentences on dwells that fit no position of the plan, and on their use."""
    of_plan = labelled.of_plan(setup.plan).segments
    names = [str(s.position) for s in labelled.segments if s not in of_plan]
    if not names:
        return []
    becomes = f'{setup.method_name} uses them all the same'
    if setup.plan_alone:
        becomes = f"{setup.method_name}, which uses the plan's positions alone, leaves them out"
    fit = f'Static dwells that count as no position of plan {setup.plan.name}'
    return [f'{fit}: {"; ".join(names)}: {becomes}.']


def assumption_findings(setup: Setup, solution: Solution) -> list[str]:
    """Return sentences on assumptions about the table that its file does not state but are used."""
    table = None if setup.plan.by_hand or solution.shares is None else setup.table
    return [table.assumption] if table is not None and table.assumption else []
