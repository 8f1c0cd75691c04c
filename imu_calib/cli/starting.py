"""The wait for a session to begin, which lasts as long as an old journal is read."""

from __future__ import annotations

import time

from ..common.errors import InputError
from ..reports.timeline import READING
from .node_reports import NodeReports

_JOURNAL = 'calibrator_node: journal'


class Start:
    """Follows the start of a session.

    Args:
        reports: Of the nodes.
        patience: Longest wait without progress in reading the journal, s.
    """

    def __init__(self, reports: NodeReports, patience: float) -> None:
        self._reports = reports
        self._patience = patience
        self._report = ''
        self._since = time.monotonic()

    @property
    def words(self) -> str:
        """What is waited for while the journal is read; else empty."""
        report = self._reports.text(_JOURNAL)
        if not report.startswith(READING):
            return ''
        return f'calibrator_node reads its journal: {report.removeprefix(READING)}'

    def check(self, otherwise: str) -> None:
        """Check that the wait is not too long.

        Args:
            otherwise: Why, if it is too long and no journal is read.

        Raises:
            InputError: It is.
        """
        now, report = time.monotonic(), self._reports.text(_JOURNAL)
        if report != self._report:
            if READING in report + self._report:
                self._since = now
            self._report = report
        if now - self._since > self._patience:
            words = self.words
            stuck = f'{words} This has not changed for {self._patience:.0f} s.' if words else ''
            raise InputError(stuck or otherwise)
