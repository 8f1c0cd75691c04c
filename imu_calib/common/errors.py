"""The two kinds of failure of a calibration, each with its exit code."""

from __future__ import annotations

import re
from copy import copy
from copyreg import __newobj__  # type: ignore[attr-defined]
from typing import TypeVar

_Error = TypeVar('_Error', bound='ImuCalibError')


class ImuCalibError(Exception):
    """Root of all errors that this package raises deliberately; the text is for the user.

    It names a keyword, or a parameter of a node, as `imu_topic`: the command line has --imu-topic.
    """

    exit_code = 2

    def __init__(self, cause: str = '', *details: str) -> None:
        super().__init__(cause, *details)

    def __reduce__(self) -> tuple[object, ...]:
        """Copy, and cross processes, without constructors: some take no details."""
        return __newobj__, (type(self), *self.args), self.__dict__

    def __str__(self) -> str:
        """Return the cause and the details."""
        return ' '.join(filter(None, self.args))

    @property
    def cause(self) -> str:
        """What is wrong, and what to do."""
        return str(self.args[0])

    @property
    def details(self) -> tuple[str, ...]:
        """What else was seen, in sentences."""
        return tuple(filter(None, self.args[1:]))

    def among(self: _Error, *, before: tuple[str, ...] = (), after: tuple[str, ...] = ()) -> _Error:
        """Return the error with other causes before it, of which the first counts, or details."""
        found = copy(self)
        found.args = (*before, *self.args, *after)
        return found

    def followed_by(self: _Error, sentence: str) -> _Error:
        """Return the error with another sentence on its cause."""
        found = copy(self)
        found.args = (f'{self.cause} {sentence}', *self.args[1:])
        return found


class InputError(ImuCalibError):
    """Wrong usage or unreadable input: file, key, topic, what was found, what was expected.

    Every function that reads a file, takes a user's value or needs an optional library raises it;
    `Raises:` states more.
    """

    exit_code = 2


class NotStated(InputError):
    """Required information is neither in the recording nor given: it must be stated."""


class NotObservable(ImuCalibError):
    """The data does not determine the result: names the parameter or position, and the reason."""

    exit_code = 1


class Contradiction(NotObservable):
    """The data contradicts itself, or its description: no weighting resolves this."""


_SENTENCES = 2  #: Of an error: what happened, and what it means.


def beginning(error: str) -> str:
    """Return the first two sentences of an error, where a list of several has no room for all."""
    sentences = re.split(r'(?<=\.) (?=[A-Z])', error)
    return ' '.join(sentences[:_SENTENCES]) + ' ...' * (len(sentences) > _SENTENCES)
