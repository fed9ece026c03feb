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


class ProviderError(AscaError):
    """Hardware or a runtime library that was asked for and is not there, or does not start."""


class ExportError(AscaError):
    """An export whose graphs do not reproduce the trained model."""


class TrainingError(AscaError):
    """A training run that cannot start or must not go on."""
