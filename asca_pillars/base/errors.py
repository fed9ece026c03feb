"""User errors: one line that names the file, the value and the remedy.

Exit codes of the command line are those of the errors' kinds; docs/guide/deploy.md lists them.
"""

from typing import ClassVar

USAGE, PARTIAL, INPUT, ENVIRONMENT = 2, 3, 4, 5
"""Exit codes: a wrong option or place, parts that could not be done, a file that cannot be used, what is missing here.

0 is success and 1 the answer no (`asca doctor`, `asca bench --deadline`), or an error of the program.
"""


class AscaError(Exception):
    """Base of every error that the command line prints as one line, without a traceback.

    Raised itself where something is not installed.
    """

    exit_code: ClassVar[int] = ENVIRONMENT


class ConfigError(AscaError):
    """A setting that cannot work: an unknown key, a wrong value, a grid that does not fit the network."""

    exit_code = USAGE


class ScanError(AscaError):
    """A scan file that cannot be read."""

    exit_code = INPUT


class PartialError(ScanError):
    """Some of the input could not be read or written; results of the rest are there."""

    exit_code = PARTIAL


class DatasetError(AscaError):
    """A dataset folder, label or calibration file that is missing or damaged."""

    exit_code = INPUT


class BundleError(AscaError):
    """A model bundle that is missing, damaged or made for another version."""

    exit_code = INPUT


class OutputError(AscaError):
    """An output place that holds something that must not be replaced."""

    exit_code = USAGE


class ProviderError(AscaError):
    """Hardware or a runtime library that was requested and is missing, or does not start."""


class ExportError(AscaError):
    """An export whose graphs do not reproduce the trained model."""

    exit_code = INPUT


class ClusterError(AscaError):
    """A cluster that cannot be reached, or whose machines are not set up alike."""


class WorkerError(AscaError):
    """A process that shared the work was killed."""


class TrainingError(AscaError):
    """A training run that cannot start or must not continue."""

    exit_code = INPUT


def printable(text: str, limit: int = 1000) -> str:
    """Return a message as one printable line of at most `limit` characters.

    Messages quote what stands in files: control characters are written as escapes, and a long text loses its middle.
    """
    # Cut first, with room for the start and end of escapes, which make the text longer again.
    text = _cut(text, 2 * limit)
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return _cut(line, limit)


def _cut(text: str, limit: int) -> str:
    if len(text) <= limit:
        return text
    head = limit * 2 // 3
    mark = f" [{len(text) - limit} characters left out] "
    return f"{text[:head]}{mark}{text[head + len(mark) - limit :]}"
