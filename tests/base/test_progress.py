"""Progress of long jobs in a log and on a terminal."""

from __future__ import annotations

import errno

import pytest

from linprim_geo.base.progress import Progress, duration


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (59.4, "59 s"), (184, "3:04"), (3723, "1:02:03")])
def test_durations_are_formatted(seconds, text):
    assert duration(seconds) == text


def test_stages_are_logged_when_they_begin(capsys):
    progress = Progress("merging", 2)
    progress.stage(0, "planes")
    progress.update(1)  # too soon after the line before
    progress.stage(1, "walls")
    Progress("merging", 2, quiet=True).stage(0, "planes")
    assert capsys.readouterr().err.splitlines() == ["merging 1/2  planes", "merging 2/2  walls"]


def test_terminal_shows_one_line_and_clears_it(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    progress = Progress("merging", 2)
    progress.stage(0, "gaps between planes")
    progress.stage(1, "walls")
    progress.note("done")
    shown = capsys.readouterr().err
    assert shown.endswith("\r" + " " * len("merging 2/2  walls") + "\rdone\n")
    assert "\r" + "merging 2/2  walls".ljust(len("merging 1/2  gaps between planes")) + "\r" in shown


def test_full_disk_of_the_log_is_ignored_and_a_closed_pipe_raises(monkeypatch):
    def failing(error):
        def write(*_):
            raise error

        return write

    progress = Progress("train", 2)
    for error in (OSError(errno.ENOSPC, "No space left on device"), OSError(errno.EIO, "Input/output error")):
        monkeypatch.setattr("sys.stderr.write", failing(error))
        progress.note("a line")
        progress.stage(0, "another")
    monkeypatch.setattr("sys.stderr.write", failing(BrokenPipeError()))
    with pytest.raises(BrokenPipeError):
        progress.note("a line")


def test_time_left_excludes_the_time_before_the_first_step(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("linprim_geo.base.progress.time.monotonic", lambda: now[0])
    progress = Progress("train", 100)
    now[0] = 500.0  # stereo
    progress.restart(100, 50)
    now[0] = 525.0
    progress.update(75)
    assert capsys.readouterr().err == "train 75/100  1/s  25 s left  \n"
