"""Errors that are the user's to mend: one line that names the file, the value and the remedy."""


class AscaError(Exception):
    """Base of every error that the command line prints as one line, without a traceback."""


class ConfigError(AscaError):
    """A setting that cannot work: an unknown key, a wrong value, a grid that does not fit the network."""


class ScanError(AscaError):
    """A scan file that cannot be read."""


class DatasetError(AscaError):
    """A dataset folder, label or calibration file that is missing or damaged."""


class BundleError(AscaError):
    """A model bundle that is missing, damaged or made for another version."""


class OutputError(AscaError):
    """A place to write to that holds something which is not ours to replace."""


class ProviderError(AscaError):
    """Hardware or a runtime library that was asked for and is not there, or does not start."""


class ExportError(AscaError):
    """An export whose graphs do not reproduce the trained model."""


class ClusterError(AscaError):
    """A cluster that cannot be reached, or whose machines are not set up alike."""


class WorkerError(AscaError):
    """A process that shared the work was killed."""


class TrainingError(AscaError):
    """A training run that cannot start or must not go on."""


def printable(text: str, limit: int = 1000) -> str:
    """A message as one line of at most `limit` characters that does nothing to a terminal.

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
