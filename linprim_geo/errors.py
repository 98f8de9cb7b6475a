"""The one exception a user is meant to read: a single sentence, shown without a traceback."""


class LinprimError(Exception):
    """Something the user gave cannot be used.

    The message is one sentence that names the file, row or option, what was found there and what was wanted.
    The command line prints it and exits with status 1; `--debug` shows the traceback as well.
    """
