"""The one exception a user is meant to read: a single sentence, shown without a traceback."""

from __future__ import annotations


def printable(text: str) -> str:
    """`text` with ? for each character that is not to be shown: what is between them may be an order to a terminal."""
    return "".join(character if character.isprintable() or character == "\n" else "?" for character in text)


class LinprimError(Exception):
    """Something the user gave cannot be used.

    The message is one sentence that names the file, row or option, what was found there and what was wanted.
    The command line prints it and exits with status 1; `--debug` shows the traceback as well. Whatever a file or a
    library has put into it, it is one line of at most LONGEST characters: line breaks become spaces, characters that
    are not to be shown question marks, and the middle is left out of one that is longer.
    """

    LONGEST = 1000

    def __init__(self, sentence: str = ""):
        sentence = printable(" ".join(str(sentence).split()))
        if len(sentence) > self.LONGEST:
            sentence = f"{sentence[:600]} ... {sentence[-(self.LONGEST - 605) :]}"
        super().__init__(sentence)


class DiskFull(LinprimError):
    """There is no space left on a device: nothing that could be done in another way."""
