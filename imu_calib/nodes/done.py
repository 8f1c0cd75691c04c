"""Whether the table's leader may be believed that a plan is done."""

from __future__ import annotations


class DoneWord:
    """Takes what turntable/state says, and believes DONE only where all speaks for it.

    The state is one node's word, and any publisher on its topic could end a session with it.
    So the calibrator has seen every step of the plan commanded, no other node publishes the state,
    and it is said twice in a row: its leader repeats it twice a second, and would contradict.

    Args:
        plan: Name of the plan that is calibrated.
        steps: How many steps it has.

    """

    def __init__(self, plan: str, steps: int) -> None:
        self._plan = plan
        self._steps = steps
        self._said = 0

    def deny(self) -> None:
        """Take a state that is not DONE."""
        self._said = 0

    def doubt(self, plan: str, steps: int, commanded: int, *, alone: bool) -> str:
        """Take a state that is DONE; return why it is not believed, empty where it is.

        Args:
            plan: What it names.
            steps: How many steps it says that the plan has.
            commanded: How many steps of the plan have been commanded, by the setpoints.
            alone: Whether the state has one publisher.

        """
        self._said += 1
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
        """Whether DONE was said more than once in a row."""
        return self._said > 1
