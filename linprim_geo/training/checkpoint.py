"""Write and read training checkpoints.

Writing always leaves a complete latest checkpoint on disk. Reading treats the file as untrusted: no code is executed.
"""

from __future__ import annotations

import math
import re
import zipfile
from pathlib import Path
from pickletools import genops

import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.training.step.trainer import SHARED, Trainer

KEPT = 2
# The only globals that the pickle of a checkpoint may name. torch's own allow list (weights_only) is longer: its
# entries execute nothing harmful, but a few bytes of pickle could make it allocate a bytearray of any size.
_MADE_OF = re.compile(r"torch\._utils _rebuild_tensor_v2|torch \w+Storage|collections OrderedDict")


def write_checkpoint(folder: Path, trainer: Trainer) -> None:
    """Write step_N.pt, then `latest`, which holds its name, then delete all but the last KEPT checkpoints."""
    name = f"step_{trainer.step:06d}.pt"
    # An open file instead of a path: write errors keep their own exception types, and the bytes in the file do not
    # depend on the temporary name.
    with atomic_write(folder / name) as temporary, open(temporary, "wb") as file:
        torch.save(trainer.state(), file)
    with atomic_write(folder / "latest") as temporary:
        temporary.write_text(name + "\n")
    for old in sorted(folder.glob("step_*.pt"), key=lambda file: (len(file.name), file.name))[:-KEPT]:
        if old.name != name:
            old.unlink()


def read_checkpoint(path: Path) -> dict | None:
    """Return the latest checkpoint in a run's folder, or None if the run has none yet. Nothing in the file is executed.

    Raises:
        LinprimError: the file is missing, damaged (a checksum is wrong), or holds anything but tensors and plain
            values.
    """
    folder = path / "checkpoints"
    try:
        name = (folder / "latest").read_text(encoding="utf-8").strip()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise LinprimError(f"{folder / 'latest'}: cannot be read ({error})") from None
    if not name.isprintable() or Path(name).name != name or len(name) > 100:
        raise LinprimError(f"{folder / 'latest'}: names {name[:100]!r}, wanted a checkpoint in this folder")
    file = folder / name
    try:
        _check_archive(file)
        state = torch.load(file, weights_only=True)
    except FileNotFoundError:
        raise LinprimError(f"{file}: the latest checkpoint is missing") from None
    except LinprimError:
        raise
    except Exception as error:  # torch raises many kinds for a damaged file
        raise LinprimError(f"{file}: is damaged and cannot be read ({type(error).__name__})") from None
    if not isinstance(state, dict):
        raise LinprimError(f"{file}: holds no checkpoint")
    return state


def restore(trainer: Trainer, state: dict, folder: Path) -> None:
    """Put the state of a checkpoint into a trainer of the same run.

    Raises:
        LinprimError: an entry is missing, not finite, or does not fit the others.
    """
    try:
        _check_state(trainer, state)
        trainer.restore(state)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise LinprimError(f"{folder}: the latest checkpoint lacks what a run needs ({reason})") from None


def _check_archive(file: Path) -> None:
    """Verify the CRC checksums of the zip archive and the contents of its pickles.

    torch.load compares no checksums, so training would go on with flipped bits.
    """
    with zipfile.ZipFile(file) as archive:
        if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
            raise LinprimError(f"{file}: is damaged and cannot be read (it is compressed, which no checkpoint is)")
        broken = archive.testzip()
        for name in archive.namelist() if broken is None else ():
            if name.endswith("data.pkl"):
                _check_pickle(file, archive.read(name))
    if broken is not None:
        raise LinprimError(f"{file}: is damaged and cannot be read (the checksum of {broken[:100]!r} is wrong)")


def _check_pickle(file: Path, content: bytes) -> None:
    """Raise LinprimError if unpickling would call anything but the globals in _MADE_OF."""
    for code, name, _ in genops(content):
        called = str(name or code.name)
        if code.name in ("STACK_GLOBAL", "INST", "OBJ") or (code.name == "GLOBAL" and not _MADE_OF.fullmatch(called)):
            found = f"it holds {called[:100]!r}, wanted tensors and numbers"
            raise LinprimError(f"{file}: is damaged and cannot be read ({found})")


def _check_state(trainer: Trainer, state: dict) -> None:
    """Check that every table is finite and has one row per primitive.

    Raises ValueError otherwise, or whatever exception a value of the wrong type causes.
    """
    count = len(state["parameters"]["center"])
    if count < 1:
        raise ValueError("there are no primitives")
    for table in ("parameters", "first", "second"):
        for name, like in getattr(trainer, table).items():
            shape = like.shape if name in SHARED else (count, *like.shape[1:])
            _check_tensor(f"{table} {name}", state[table][name], like.dtype, shape)
    if any(bool((value < 0).any()) for value in state["second"].values()):
        raise ValueError("a second moment is negative")
    _check_tensor("steps", state["steps"], torch.int32, (count,))
    for name in trainer.control.NAMES:
        _check_tensor(f"accumulated {name}", state["accumulated"][name], torch.float32, (count,))
    if (state["filter_3d"] is None) != (trainer.filter_3d is None):
        raise ValueError("filter_3d belongs to a run with another --filter")
    if state["filter_3d"] is not None:
        _check_tensor("filter_3d", state["filter_3d"], torch.float32, (count,))
    step, (low, high) = state["step"], state["bounds"]
    if type(step) is not int or not 0 <= step < 2**40 or not 0 < low <= high < math.inf:
        raise ValueError(f"step {step!r} or bounds {low!r}, {high!r}")
    if (
        not all(type(state[name]) is float for name in ("seconds", "loss", "psnr"))
        or not 0 <= state["seconds"] < math.inf
    ):
        raise ValueError("seconds, loss and psnr are no numbers")
    numbers = trainer.control.state()
    if len(state["control"]) != len(numbers) or not all(
        type(x) in (int, float) and math.isfinite(x) for x in state["control"]
    ):
        raise ValueError(f"control is {state['control']!r}")
    if trainer.exposure is not None:
        for name, like in trainer.exposure.state().items():
            _check_tensor(f"exposure {name}", state["exposure"][name], like.dtype, like.shape)


def _check_tensor(name: str, value, dtype: torch.dtype, shape: tuple) -> None:
    if (
        not isinstance(value, torch.Tensor)
        or value.dtype != dtype
        or tuple(value.shape) != tuple(shape)
        or value.layout != torch.strided
    ):
        raise ValueError(f"{name} is no {dtype} tensor of shape {tuple(shape)}")
    if (
        not value.is_contiguous()
        or value.requires_grad
        or (value.is_floating_point() and not bool(torch.isfinite(value).all()))
    ):
        raise ValueError(f"{name} is not finite")
