"""The exception whose message is for users: a single sentence, shown without a traceback."""

from __future__ import annotations


def printable(text: str) -> str:
    """Return `text` with ? for each non-printable character, which might be part of a terminal control sequence."""
    return "".join(character if character.isprintable() or character == "\n" else "?" for character in text)


class LinprimError(Exception):
    """Input from the user that cannot be used.

    The message is one sentence that names the file, row or option, what was found there and what was expected.
    The command line prints it and exits with status 1; `--debug` also shows the traceback. The message is always one
    line of at most LONGEST characters, whatever a file or a library has put into it: line breaks become spaces,
    non-printable characters question marks, and the middle of a longer text is left out.
    """

    LONGEST = 1000

    def __init__(self, sentence: str = ""):
        sentence = printable(" ".join(str(sentence).split()))
        if len(sentence) > self.LONGEST:
            sentence = f"{sentence[:600]} ... {sentence[-(self.LONGEST - 605) :]}"
        super().__init__(sentence)


class DiskFull(LinprimError):
    """No space is left on a device. No fallback can avoid this error."""
