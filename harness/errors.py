"""Errors that the command line prints as one line."""


class UsageError(ValueError):
    """What was asked for cannot be done. The command line prints it as one line and exits with
    code 2."""


class FolderInUse(UsageError):
    """Another process trains in the run's folder."""


class EnvironmentFailed(RuntimeError):
    """An environment did what it must not do (see border.Border)."""
