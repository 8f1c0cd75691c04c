"""The two kinds of failure of a calibration, each with its exit code."""


class ImuCalibError(Exception):
    """Root of all errors that this package raises deliberately; the text is for the user.

    It names a keyword, or a parameter of a node, as `imu_topic`: the command line has --imu-topic.
    """

    exit_code = 2


class InputError(ImuCalibError):
    """Wrong usage or unreadable input: file, key, topic, what was found, what was expected.

    Every function that reads a file or takes a user's value raises it; `Raises:` states more.
    """

    exit_code = 2


class NotStated(InputError):
    """Required information is neither in the recording nor given: it must be stated."""


class NotObservable(ImuCalibError):
    """The data does not determine the result: names the parameter or position, and the reason."""

    exit_code = 1


class Contradiction(NotObservable):
    """The data contradicts itself, or its description: no weighting resolves this."""
