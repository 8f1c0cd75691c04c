"""Whether a reported DONE of a plan is credible."""

from __future__ import annotations


class DoneCheck:
    """Receives turntable/state, and accepts DONE only with independent evidence.

    Any publisher on the topic could end a session. Therefore the calibrator must have received
    setpoints of every step, no other node may publish the state, and DONE must come twice in
    succession: the node that runs the plan repeats its state twice a second and would contradict.

    Args:
        plan: Name of the plan that is calibrated.
        steps: Number of its steps.
    """

    def __init__(self, plan: str, steps: int) -> None:
        self._plan = plan
        self._steps = steps
        self._in_succession = 0

    def deny(self) -> None:
        """Record a state other than DONE."""
        self._in_succession = 0

    def refusal(self, plan: str, steps: int, commanded: int, *, alone: bool) -> str:
        """Record a state DONE; return why it is not accepted, else empty.

        Args:
            plan: Name of the plan in the state.
            steps: Number of steps in the state.
            commanded: Number of steps commanded by setpoints.
            alone: Whether the state has one publisher.
        """
        self._in_succession += 1
        if plan != self._plan:
            return f'it names the plan {plan or "(none)"}, not {self._plan}'
        if steps != self._steps:
            return f'it has {steps} steps, plan {self._plan} has {self._steps}'
        if commanded < self._steps:
            first = f'{commanded + 1} to ' if commanded + 1 < self._steps else ''
            return f'step {first}{self._steps} of {self._plan} was never commanded'
        if not alone:
            return 'more than one node publishes the state'
        return ''

    @property
    def is_repeated(self) -> bool:
        """Whether DONE was received more than once in succession."""
        return self._in_succession > 1
