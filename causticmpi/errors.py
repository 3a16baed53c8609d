"""Errors that are one line for the user: bad input (code 2), a result that could not be kept (code 1).

Everything else is a defect and ends with code 1 and a traceback."""


class InputError(Exception):
    """Bad input: one line that says where, what was found, what is allowed and how to mend it.

    The command line prints it once and exits with code 2; nothing has been written by then.
    """

    def __init__(self, message: str, file: object = None, line: int | None = None) -> None:
        where = "" if file is None else f"{file}: " if line is None else f"{file}:{line}: "
        super().__init__(where + " ".join(message.split()))


def reason(error: Exception) -> str:
    """What the system says of a file, for a message: one line without number and path."""
    return " ".join((getattr(error, "strerror", None) or str(error)).lower().split())


class RunError(Exception):
    """A run whose result could not be written: every rank knows, the root prints the line, exit code 1."""
