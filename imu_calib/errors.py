"""The two ways in which a calibration can fail, each with its exit code."""


class ImuCalibError(Exception):
    """Root of all errors that this package raises on purpose; the text is for a person.

    It names a keyword, or a parameter of a node, as `imu_topic`: the command line says --imu-topic.
    """

    exit_code = 2


class InputError(ImuCalibError):
    """Wrong usage or unreadable input: file, key, topic, what was found, what was expected."""

    exit_code = 2


class NotStated(InputError):
    """A recording does not say what it means: nothing is wrong with it, and more must be stated."""


class NotObservable(ImuCalibError):
    """The data cannot give the answer: which parameter or position, and why."""

    exit_code = 1


class Contradiction(NotObservable):
    """The data contradicts itself, or what is said of it: no weights can reconcile the two."""
